# SPDX-License-Identifier: Apache-2.0
"""The ASGI application.

``python -m pugeo_service.app`` prints its OpenAPI document.
"""

import asyncio
import json
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import structlog
from fastapi import Depends, FastAPI
from starlette.middleware.cors import CORSMiddleware

from pugeo_model.malloc import give_back_freed_memory
from pugeo_service import __version__, problems
from pugeo_service.admission.admission import Admission
from pugeo_service.container import Service
from pugeo_service.engine import Engine, EngineStartError
from pugeo_service.http import openapi
from pugeo_service.http.auth import RequireKey
from pugeo_service.http.head_requests import AnswerHead
from pugeo_service.http.middleware import RequestContext
from pugeo_service.http.query_names import check_query
from pugeo_service.http.security_headers import CORS
from pugeo_service.jobs import JobManager
from pugeo_service.keys import Keys
from pugeo_service.models import Models
from pugeo_service.observability import tracing
from pugeo_service.observability.telemetry import Readings, Telemetry
from pugeo_service.routes import docs, health, metrics, page, preview, upsample
from pugeo_service.routes import jobs as job_routes
from pugeo_service.routes import models as model_routes
from pugeo_service.settings import Settings

__all__ = ["create_app", "create_metrics_app", "create_service"]

_log = structlog.stdlib.get_logger("pugeo.service")
_RELEASE_MEMORY_S = 10.0


def create_service(settings: Settings, models: Models) -> Service:
    """Build all parts of the service without starting any."""
    engine = Engine(settings, models.default.id)
    admission = Admission(settings.queue_patches, settings.queue_bytes, settings.queue_requests)

    def read() -> Readings:
        status = engine.status
        return Readings(
            queue_patches=admission.patches,
            queue_capacity=admission.max_patches,
            queue_bytes=admission.bytes + jobs.uploads.bytes,
            workers_warm=status.workers,
            workers_missing=max(0, (status.expected or 0) - status.workers),
            workers_lost=status.lost,
            patches_retried=status.retried,
            jobs_queued=jobs.usage.queued,
            jobs_running=jobs.usage.running,
            jobs_bytes=jobs.usage.bytes,
            jobs_patches=jobs.admission.patches,
            jobs_capacity=jobs.admission.max_patches,
            models=[model.described for model in models],
            uses=status.uses,
        )

    telemetry = Telemetry(read, __version__)
    keys = Keys(settings.api_keys_file, settings.api_keys)
    jobs = JobManager(settings, engine, telemetry, models, keys.version)
    return Service(
        settings=settings,
        engine=engine,
        admission=admission,
        jobs=jobs,
        keys=keys,
        telemetry=telemetry,
        models=models,
    )


def create_app(
    settings: Settings | None = None,
    on_fatal: Callable[[], object] = lambda: None,
    on_ready: Callable[[], object] = lambda: None,
    models: Models | None = None,
) -> FastAPI:
    """Make the application.

    Args:
        settings: settings; from the environment by default.
        on_fatal: called if the engine cannot start, because no request could be served.
        on_ready: called once the engine has started.
        models: those of the settings by default.

    Raises:
        BadOptionError: the default model or the canary cannot be used.
    """
    settings = settings or Settings()
    service = create_service(settings, models or Models(settings))

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        # In the background, so that probes are answered while the model is loading.
        starting = asyncio.create_task(_start(service, on_fatal, on_ready))
        releasing = asyncio.create_task(_release_memory())
        watching = asyncio.create_task(service.models.watch(service.engine))
        await service.jobs.start()
        yield
        service.drain()
        background = (starting, releasing, watching)
        for task in background:
            task.cancel()
        await asyncio.gather(*background, return_exceptions=True)
        # Before the workers: running jobs are queued again and their tasks cancelled.
        await service.jobs.stop()
        await service.engine.stop()

    app = FastAPI(
        title="pugeo",
        version=__version__,
        summary="Point cloud upsampling: more points, on the surface, each with a normal.",
        lifespan=lifespan,
        # FastAPI's own pages load scripts from the internet, and its document takes any query.
        openapi_url=None,
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        telemetry=tracing.configuration(),
    )
    app.state.service = service
    problems.install(app, "/openapi.json")
    # The last one added is the outermost.
    app.add_middleware(AnswerHead)
    # CORS is outside of keys: a preflight has no key.
    if service.keys.required:
        app.add_middleware(RequireKey, keys=service.keys, telemetry=service.telemetry)
    if service.settings.cors_origins:
        app.add_middleware(CORSMiddleware, allow_origins=service.settings.cors_origins, **CORS)
    app.add_middleware(RequestContext, telemetry=lambda: service.telemetry)
    modules = [upsample, preview, job_routes, model_routes, health, docs]
    if service.settings.metrics_port is None:
        modules.append(metrics)
    for module in modules:
        app.include_router(module.router, dependencies=[Depends(check_query)])
    # Programs that pass on links to the page append names of their own.
    app.include_router(page.router)
    openapi.install(app)
    return app


def create_metrics_app(service: Service) -> FastAPI:
    """Make the application of the separate port of metrics.

    Its only route is ``/metrics``, with the checks and headers that it has on the main port.

    Args:
        service: the service whose metrics are served.
    """
    app = FastAPI(title="pugeo metrics", openapi_url=None, redirect_slashes=False)
    app.state.service = service
    problems.install(app)
    app.add_middleware(AnswerHead)
    app.add_middleware(RequestContext, telemetry=lambda: service.telemetry)
    app.include_router(metrics.router, dependencies=[Depends(check_query)])
    return app


async def _start(
    service: Service, on_fatal: Callable[[], object], on_ready: Callable[[], object]
) -> None:
    try:
        await service.models.install(service.engine)
        await service.engine.start()
    except EngineStartError as error:
        _log.error("the engine cannot start", reason=str(error))
        on_fatal()
        return
    except Exception:  # noqa: BLE001 - logged, and the process ends
        _log.exception("the engine cannot start")
        on_fatal()
        return
    _log.info("ready", workers=service.engine.status.workers, model=service.models.default.name)
    on_ready()


async def _release_memory() -> None:
    """Return freed memory of bodies and answers to the system, every 10 s."""
    while True:
        await asyncio.sleep(_RELEASE_MEMORY_S)
        await asyncio.to_thread(give_back_freed_memory)


def _print_openapi() -> None:
    # Independent of this environment: the document is the same for all services.
    app = create_app(Settings(metrics_port=None, api_keys=None, api_keys_file=None))
    sys.stdout.write(json.dumps(app.openapi(), indent=2, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    _print_openapi()
