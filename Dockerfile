# SPDX-License-Identifier: Apache-2.0
ARG BASE=python:3.12-slim-bookworm

# ---- what the service needs, and the service, in /opt/venv ----
FROM ${BASE} AS build
ARG TORCH_VERSION=2.13.0
ARG TORCH_INDEX_URL=https://download.pytorch.org/whl/cpu
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 \
    PIP_NO_COMPILE=1
WORKDIR /src
RUN python3 -m venv /opt/venv
ENV PATH=/opt/venv/bin:$PATH
COPY constraints.txt pyproject.toml ./
COPY deploy/image/requirements.py deploy/image/prune.py deploy/image/
RUN --mount=type=cache,target=/root/.cache/pip \
    pip install --no-deps --index-url "${TORCH_INDEX_URL}" "torch==${TORCH_VERSION}"
RUN --mount=type=cache,target=/root/.cache/pip \
    python deploy/image/requirements.py otel postgres store surfaces > requirements.txt \
    && pip install --constraint constraints.txt --requirement requirements.txt hatchling
COPY LICENSE README.md ./
COPY client client
COPY model model
COPY service service
RUN pip install --no-cache-dir --no-deps --no-build-isolation . \
    && pip uninstall --yes hatchling pip \
    && python deploy/image/prune.py /opt/venv

# ---- what runs ----
FROM ${BASE}
LABEL org.opencontainers.image.title="pugeo" \
      org.opencontainers.image.description="Geometry-centric 3D point cloud upsampling service" \
      org.opencontainers.image.licenses="Apache-2.0"
RUN groupadd --gid 10001 pugeo \
    && useradd --uid 10001 --gid 10001 --no-create-home --home-dir /nonexistent --shell /usr/sbin/nologin pugeo \
    && install --directory --owner=10001 --group=10001 /var/cache/pugeo /var/lib/pugeo /var/spool/pugeo
COPY --from=build /opt/venv /opt/venv
ENV PATH=/opt/venv/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    OMP_NUM_THREADS=1 \
    MALLOC_ARENA_MAX=1 \
    NUMBA_CACHE_DIR=/var/cache/pugeo \
    PUGEO_HOST=0.0.0.0 \
    PUGEO_PORT=8000 \
    PUGEO_LOG_FORMAT=json \
    PUGEO_SPOOL_DIR=/var/spool/pugeo \
    PUGEO_JOBS_DIR=/var/lib/pugeo/jobs
USER 10001:10001
WORKDIR /var/spool/pugeo
# The kernels are compiled here once; a host with another processor compiles its own into the same
# folder.
RUN ["python", "-c", "from pugeo_model.kernel_cache import compile_kernels; compile_kernels(print)"]
EXPOSE 8000
STOPSIGNAL SIGTERM
# The first start on another processor compiles; it gets two minutes before a failed probe counts.
HEALTHCHECK --interval=15s --timeout=5s --start-period=120s --retries=3 \
    CMD ["python", "-c", "import os, urllib.request as u; u.urlopen(f'http://127.0.0.1:{os.environ[\"PUGEO_PORT\"]}/health/live', timeout=4).close()"]
CMD ["python", "-m", "pugeo_service"]
