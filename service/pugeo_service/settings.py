# SPDX-License-Identifier: Apache-2.0
"""Settings from the environment (``PUGEO_*``) or the command line."""

import base64
import difflib
import math
import os
import re
import ssl
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryFile
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, field_validator, model_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from pugeo_model.cpus import available_cpus
from pugeo_service import keys
from pugeo_service.memory_setting import check_memory
from pugeo_service.url_settings import (
    check_database,
    check_host,
    check_scheduler,
    check_store,
)

__all__ = ["Settings", "explain", "unknown_names"]

MIB = 1 << 20
_ORIGIN = re.compile(r"https?://[^/\s,*?#]+")
_TEN_YEARS_S = 315_360_000
# Finite: an infinite number of seconds reaches dates, timers and the database, which have none.
Seconds = Annotated[float, Field(gt=0, le=_TEN_YEARS_S, allow_inf_nan=False)]
# Databases have integers of 64 bits, and JSON those of 53.
Count = Annotated[int, Field(ge=1, le=1 << 53)]
# Names that the command line, the SDK and the files of docker compose read.
_OTHER_NAMES = frozenset({
    "PUGEO_API_KEY", "PUGEO_BIND", "PUGEO_CACHE", "PUGEO_CERTIFICATES",
    "PUGEO_CONNECTIONS_PER_ADDRESS", "PUGEO_CPUS", "PUGEO_DOMAIN", "PUGEO_FRONTS",
    "PUGEO_FRONT_PORTS", "PUGEO_MEMORY", "PUGEO_PROXY_BIND", "PUGEO_PUBLIC_PORT", "PUGEO_PYTHON",
    "PUGEO_REMOTE_WRITE_PASSWORD", "PUGEO_REMOTE_WRITE_URL", "PUGEO_REMOTE_WRITE_USER",
    "PUGEO_REPLICAS", "PUGEO_REQUESTS_PER_ADDRESS", "PUGEO_UPSTREAMS", "PUGEO_URL",
})  # fmt: skip


class Settings(BaseSettings):
    """Settings of one service process; every field is also ``PUGEO_<NAME>``."""

    model_config = SettingsConfigDict(env_prefix="PUGEO_", extra="ignore", frozen=True)

    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535, description="0 takes a free port")] = 8000
    metrics_port: Annotated[
        int | None, Field(ge=0, le=65535, description="separate port for metrics")
    ] = None
    api_keys: Annotated[
        tuple[keys.Entry, ...] | None,
        NoDecode,
        Field(description="comma-separated NAME:SHA256 entries; no key is required if unset"),
    ] = None
    api_keys_file: Annotated[
        Path | None, Field(description="file of such entries, read again when it changes")
    ] = None
    cors_origins: Annotated[
        tuple[str, ...],
        NoDecode,
        Field(description="comma-separated origins whose pages may call the service; * for all"),
    ] = ()
    log_format: Literal["auto", "json", "console"] = "auto"
    log_level: Literal["debug", "info", "warning", "error"] = "info"

    model: Annotated[
        str, Field(description="name of the default model, or path of its weights")
    ] = "standard"
    models_dir: Annotated[
        Path | None,
        Field(description="folder of further models, read again when it changes"),
    ] = None
    canary: Annotated[
        tuple[str, float] | None,
        NoDecode,
        Field(description="NAME:SHARE of a model for a share of the requests that name none"),
    ] = None
    engine: Annotated[
        Literal["dask", "inline"],
        Field(description="inline: threads in this process, for debugging"),
    ] = "dask"
    workers: Annotated[
        int, Field(ge=0, le=1024, description="0: one per processor, at least two")
    ] = 0
    worker_memory: Annotated[
        str, Field(description="memory limit of a worker in bytes, or as a fraction of all memory")
    ] = "auto"
    start_s: Annotated[
        Seconds, Field(description="maximum seconds until the first worker is ready")
    ] = 300.0
    scheduler: Annotated[
        str | None, Field(description="tls://host:port of an external Dask cluster")
    ] = None
    tls_ca: Path | None = None
    tls_cert: Path | None = None
    tls_key: Path | None = None

    max_body_bytes: Count = 256 * MIB
    max_points: Count = 5_000_000
    max_cloud_bytes: Annotated[
        Count, Field(description="maximum bytes of an input with all attributes, unpacked")
    ] = 512 * MIB
    max_output_points: Count = 20_000_000
    max_output_bytes: Annotated[
        Count, Field(description="maximum bytes of the points of an answer with all attributes")
    ] = 2048 * MIB
    preview_points: Annotated[
        int, Field(ge=8, description="maximum points that a surface preview is made of")
    ] = 100_000
    queue_patches: Annotated[Count, Field(description="capacity of the queue in patches")] = 4096
    queue_bytes: Annotated[Count, Field(description="bytes of bodies and answers at one time")] = (
        1024 * MIB
    )
    queue_requests: Annotated[Count, Field(description="capacity of the queue in requests")] = 64

    deadline_s: Annotated[Seconds, Field(description="maximum seconds of a request")] = 600.0
    body_idle_s: Annotated[
        Seconds, Field(description="maximum seconds between two chunks of a body")
    ] = 30.0
    max_connections: Annotated[Count, Field(description="maximum number of open connections")] = (
        4096
    )
    drain_delay_s: Annotated[
        float,
        Field(
            ge=0,
            le=_TEN_YEARS_S,
            allow_inf_nan=False,
            description="seconds to answer 'draining' before the port closes",
        ),
    ] = 0.0
    drain_s: Annotated[
        int,
        Field(
            ge=1, le=_TEN_YEARS_S, description="seconds after SIGTERM to finish admitted requests"
        ),
    ] = 60
    spool_dir: Annotated[
        Path, Field(description="folder for temporary files of bodies and answers")
    ] = Path(tempfile.gettempdir())

    jobs_dir: Annotated[
        Path | None, Field(description="folder for files of jobs; put it on a durable disk")
    ] = None
    jobs_store: Annotated[
        str | None,
        Field(description="s3://bucket/prefix or another URL of fsspec for inputs and results"),
    ] = None
    database_url: Annotated[
        str | None, Field(description="postgresql://... for jobs instead of SQLite in jobs_dir")
    ] = None
    jobs_queue: Annotated[Count, Field(description="maximum number of queued and running jobs")] = (
        1000
    )
    jobs_bytes: Annotated[Count, Field(description="maximum bytes of inputs and results")] = (
        16 * 1024 * MIB
    )
    jobs_running: Annotated[Count, Field(description="maximum number of running jobs")] = 2
    jobs_attempts: Annotated[
        Count, Field(description="crashes of the service during one job before that job fails")
    ] = 5
    jobs_ttl_s: Annotated[Seconds, Field(description="seconds until a result is deleted")] = 86400.0
    jobs_deadline_s: Annotated[Seconds, Field(description="maximum seconds of a job")] = 3600.0

    webhook_secret: Annotated[
        str | None,
        Field(description="whsec_BASE64: signs webhooks of jobs; without it there are none"),
    ] = None
    webhook_private: Annotated[
        bool, Field(description="webhooks may go to addresses that are not public")
    ] = False

    @field_validator("webhook_secret")
    @classmethod
    def _signing_key(cls, value: str | None) -> str | None:
        if value is None:
            return None
        try:
            key = base64.b64decode(value.removeprefix("whsec_"), validate=True)
        except ValueError:
            key = b""
        if not value.startswith("whsec_") or not 24 <= len(key) <= 64:
            raise ValueError(
                "must be whsec_ and 24 to 64 bytes in base64, such as the output of "
                "echo whsec_$(head -c 32 /dev/urandom | base64)"
            )
        return value

    @field_validator("api_keys", mode="before")
    @classmethod
    def _entries(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        entries = keys.parse(value.split(","))
        if not entries:
            # An empty secret must not disable authentication.
            raise ValueError("contains no key; unset it to require no key")
        return entries

    @field_validator("api_keys_file", mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        if value == "":
            raise ValueError("names no file; unset it to require no key")
        return value

    @field_validator("cors_origins", mode="before")
    @classmethod
    def _origins(cls, value: Any) -> Any:
        origins = value.replace(" ", "").split(",") if isinstance(value, str) else list(value)
        for origin in filter(None, origins):
            if origin != "*" and not _ORIGIN.fullmatch(origin):
                raise ValueError(f"{origin!r} is not an origin such as https://example.org")
        return tuple(filter(None, origins))

    @field_validator("canary", mode="before")
    @classmethod
    def _name_and_share(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        name, _, share = value.partition(":")
        try:
            part = float(share)
        except ValueError:
            part = math.nan
        if not name or not 0.0 <= part <= 1.0:
            raise ValueError("must be NAME:SHARE with a share from 0 to 1, such as next:0.05")
        return name, part

    @field_validator("models_dir")
    @classmethod
    def _models(cls, value: Path | None) -> Path | None:
        if value is not None and not value.is_dir():
            raise ValueError("is not a folder")
        return value

    @field_validator("host")
    @classmethod
    def _host(cls, value: str) -> str:
        return check_host(value)

    @field_validator("scheduler")
    @classmethod
    def _encrypted(cls, value: str | None) -> str | None:
        return None if value is None else check_scheduler(value)

    @field_validator("database_url")
    @classmethod
    def _database(cls, value: str | None) -> str | None:
        return None if value is None else check_database(value)

    @field_validator("jobs_store")
    @classmethod
    def _store(cls, value: str | None) -> str | None:
        return None if value is None else check_store(value)

    @field_validator(
        "spool_dir", "jobs_dir", "models_dir", "tls_ca", "tls_cert", "tls_key", mode="before"
    )
    @classmethod
    def _path(cls, value: Any) -> Any:
        # An empty path would be the current folder.
        if value == "":
            raise ValueError("names no file or folder; unset it for the default")
        return value

    @field_validator("spool_dir")
    @classmethod
    def _folder(cls, value: Path) -> Path:
        if not value.is_dir():
            raise ValueError("is not a folder")
        try:
            TemporaryFile(dir=value).close()
        except OSError as error:
            raise ValueError(f"no file can be made in this folder: {error.strerror}") from None
        return value

    @field_validator("tls_ca", "tls_cert", "tls_key")
    @classmethod
    def _readable(cls, value: Path | None) -> Path | None:
        try:
            if value is not None:
                value.open("rb").close()
        except OSError as error:
            raise ValueError(f"must be a file in PEM form: {error.strerror}") from None
        return value

    @field_validator("worker_memory")
    @classmethod
    def _memory(cls, value: str) -> str:
        return check_memory(value)

    @model_validator(mode="after")
    def _credentials(self) -> Self:
        missing = [n for n in ("tls_ca", "tls_cert", "tls_key") if getattr(self, n) is None]
        if self.scheduler is not None and missing:
            names = ", ".join(f"PUGEO_{name.upper()}" for name in missing)
            raise ValueError(f"PUGEO_SCHEDULER needs {names} as well")
        if self.scheduler is not None:
            context = ssl.create_default_context(ssl.Purpose.SERVER_AUTH)
            try:
                context.load_verify_locations(self.tls_ca)
            except ssl.SSLError:
                raise ValueError(
                    f"PUGEO_TLS_CA={self.tls_ca}: no certificate in PEM form"
                ) from None
            try:
                context.load_cert_chain(str(self.tls_cert), self.tls_key)
            except ssl.SSLError as error:
                raise ValueError(
                    f"PUGEO_TLS_CERT={self.tls_cert}, PUGEO_TLS_KEY={self.tls_key}: no certificate "
                    f"with its key in PEM form ({error.reason or error})"
                ) from None
        if self.metrics_port is not None and self.metrics_port == self.port != 0:
            raise ValueError(f"PUGEO_METRICS_PORT={self.port} must differ from PUGEO_PORT")
        return self

    @property
    def jobs_folder(self) -> Path:
        """Folder of jobs.

        By default it is named after the port, which differs among the services of a machine. With
        port 0 it is deleted at the end, because clients cannot find the service again.
        """
        if self.jobs_dir is not None:
            return self.jobs_dir
        name = f"process-{os.getpid()}" if self.jobs_folder_is_private else str(self.port)
        return self.spool_dir / f"pugeo-jobs-{name}"

    @property
    def jobs_folder_is_private(self) -> bool:
        """Whether the folder of jobs is deleted at the end of this process."""
        return self.jobs_dir is None and self.port == 0

    @property
    def jobs_database(self) -> str:
        """URL of the database of jobs."""
        return self.database_url or f"sqlite:///{self.jobs_folder.absolute()}/jobs.sqlite3"

    @property
    def fronts_share_no_folder(self) -> bool:
        """True if files and table of jobs are elsewhere, so that fronts need no common folder."""
        return self.jobs_store is not None and self.database_url is not None

    @property
    def worker_count(self) -> int:
        """Worker processes of the local cluster.

        At least two, so that one can serve while the other runs a long stage or is replaced.
        """
        return self.workers or max(2, available_cpus())


# Values that may contain a secret.
_SECRET = frozenset({"api_keys", "database_url", "jobs_store", "webhook_secret"})


def explain(error: ValidationError) -> Iterator[str]:
    """Yield a line for each wrong setting: its name, its value, and the values that are allowed."""
    for entry in error.errors():
        message = entry["msg"].removeprefix("Value error, ").removeprefix("Input ")
        if not entry["loc"]:
            yield message
            continue
        field = str(entry["loc"][0])
        value = "..." if field in _SECRET else str(entry["input"])[:80]
        yield f"PUGEO_{field.upper()}={value}: {message}"


def unknown_names(environment: Iterable[str]) -> dict[str, str | None]:
    """Return the names ``PUGEO_*`` that no part of pugeo reads, each with a similar one if any."""
    known = {f"PUGEO_{name.upper()}" for name in Settings.model_fields}
    found: dict[str, str | None] = {}
    for name in sorted(environment):
        upper = name.upper()
        ours = upper.startswith("PUGEO_") and not upper.startswith("PUGEO_TEST_")
        if ours and upper not in known | _OTHER_NAMES:
            similar = difflib.get_close_matches(upper, known, 1)
            found[name] = similar[0] if similar else None
    return found
