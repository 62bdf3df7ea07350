# SPDX-License-Identifier: Apache-2.0
"""The application: settings in, ASGI out."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import structlog
from fastapi import FastAPI

from pugeo_model import weights
from pugeo_service import __version__, problems
from pugeo_service.admission import Admission
from pugeo_service.engine import Engine
from pugeo_service.middleware import RequestContext
from pugeo_service.routes import health, metrics, models, upsample
from pugeo_service.settings import Settings
from pugeo_service.state import Service
from pugeo_service.telemetry import Readings, Telemetry

__all__ = ["create_app", "create_service"]

_log = structlog.stdlib.get_logger("pugeo.service")


def create_service(settings: Settings) -> Service:
    """Put together what the routes share; starts nothing.

    Raises:
        BadOption: there are no weights of that name.
    """
    card = weights.read_card(settings.model)
    engine = Engine(settings)
    admission = Admission(settings.queue_patches, settings.queue_bytes, settings.queue_requests)

    def read() -> Readings:
        status = engine.status
        return Readings(
            queue_patches=admission.patches,
            queue_capacity=admission.max_patches,
            queue_bytes=admission.bytes,
            workers_warm=status.workers,
            workers_missing=max(0, (status.expected or 0) - status.workers),
            workers_lost=status.lost,
        )

    model = {key: str(card[key]) for key in ("name", "version", "sha256")}
    return Service(settings, engine, admission, Telemetry(read, __version__, model), card)


def create_app(
    settings: Settings | None = None, on_fatal: Callable[[], object] = lambda: None
) -> FastAPI:
    """Make the application.

    Args:
        settings: from the environment by default.
        on_fatal: is called when the engine cannot start, since nothing would ever be served.
    """
    service = create_service(settings or Settings())

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        # In the background: a probe must be answered while the model is still loading.
        starting = asyncio.create_task(_start(service, on_fatal))
        yield
        service.admission.draining = True
        starting.cancel()
        await asyncio.gather(starting, return_exceptions=True)
        await service.engine.stop()

    app = FastAPI(
        title="pugeo",
        version=__version__,
        summary="Point cloud upsampling: more points, on the surface, each with a normal.",
        lifespan=lifespan,
        # The stock pages load their scripts from somebody else's server.
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
    )
    app.state.service = service
    problems.install(app)
    app.add_middleware(RequestContext, telemetry=lambda: service.telemetry)
    for module in (upsample, models, health, metrics):
        app.include_router(module.router)
    return app


async def _start(service: Service, on_fatal: Callable[[], Any]) -> None:
    try:
        await service.engine.start()
    except Exception:  # noqa: BLE001 - whatever it is, the log has it and the process ends
        _log.exception("the engine cannot start")
        on_fatal()
        return
    _log.info("ready", workers=service.engine.status.workers, model=service.card["name"])
