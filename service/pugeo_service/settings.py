# SPDX-License-Identifier: Apache-2.0
"""What can be set, from the environment (``PUGEO_*``) or the command line."""

import tempfile
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from pugeo_service.cpus import available_cpus

__all__ = ["Settings"]

MIB = 1 << 20


class Settings(BaseSettings):
    """Settings of one service process; every field is also ``PUGEO_<NAME>``."""

    model_config = SettingsConfigDict(env_prefix="PUGEO_", extra="ignore", frozen=True)

    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535, description="0 takes a free port")] = 8000
    log_format: Literal["auto", "json", "console"] = "auto"
    log_level: Literal["debug", "info", "warning", "error"] = "info"

    model: Annotated[str, Field(description="name or path of the weights")] = "standard"
    engine: Annotated[
        Literal["dask", "inline"], Field(description="inline: threads in this process, to debug")
    ] = "dask"
    workers: Annotated[int, Field(ge=0, description="0: one a processor, two at least")] = 0
    worker_memory: Annotated[
        str, Field(description="bytes a worker may hold before it is replaced, or a share")
    ] = "auto"
    scheduler: Annotated[
        str | None, Field(description="tls://host:port of a Dask cluster that runs elsewhere")
    ] = None
    tls_ca: Path | None = None
    tls_cert: Path | None = None
    tls_key: Path | None = None

    max_body_bytes: Annotated[int, Field(ge=1)] = 256 * MIB
    max_points: Annotated[int, Field(ge=1)] = 2_000_000
    max_output_points: Annotated[int, Field(ge=1)] = 4_000_000
    queue_patches: Annotated[int, Field(ge=1, description="patches admitted at one time")] = 4096
    queue_bytes: Annotated[int, Field(ge=1, description="bytes of bodies held at one time")] = (
        1024 * MIB
    )
    queue_requests: Annotated[int, Field(ge=1, description="requests admitted at one time")] = 64
    batch_patches: Annotated[int, Field(ge=1, description="patches of one task")] = 1

    deadline_s: Annotated[float, Field(gt=0, description="seconds a request may take")] = 600.0
    body_idle_s: Annotated[float, Field(gt=0, description="seconds between two body chunks")] = 30.0
    drain_delay_s: Annotated[
        float, Field(ge=0, description="seconds to answer 'draining' before the port closes")
    ] = 0.0
    drain_s: Annotated[int, Field(ge=1, description="seconds to finish accepted work")] = 60
    spool_dir: Annotated[Path, Field(description="folder of bodies and results on their way")] = (
        Path(tempfile.gettempdir())
    )

    @field_validator("scheduler")
    @classmethod
    def _encrypted(cls, value: str | None) -> str | None:
        # A scheduler runs whatever it is sent: without mutual TLS it is a remote shell.
        if value is not None and not value.startswith("tls://"):
            raise ValueError("the scheduler must be reached over tls://host:port")
        return value

    @field_validator("spool_dir")
    @classmethod
    def _folder(cls, value: Path) -> Path:
        if not value.is_dir():
            raise ValueError(f"{value} is not a folder")
        return value

    @model_validator(mode="after")
    def _credentials(self) -> Self:
        missing = [n for n in ("tls_ca", "tls_cert", "tls_key") if getattr(self, n) is None]
        if self.scheduler is not None and missing:
            raise ValueError(f"a scheduler elsewhere needs {', '.join(missing)} as well")
        return self

    @property
    def worker_count(self) -> int:
        """Worker processes of the local cluster.

        Two at least: while one runs a long step or is being replaced, the other serves.
        """
        return self.workers or max(2, available_cpus())
