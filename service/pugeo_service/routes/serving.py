# SPDX-License-Identifier: Apache-2.0
"""The way of a cloud through the service within one request: body, queue, engine, deadline."""

import asyncio
from contextlib import ExitStack
from typing import Any

from fastapi import Request

from pugeo_service.admission.admission import Reservation
from pugeo_service.admission.deadline import Deadline, DeadlinePassedError
from pugeo_service.container import Service
from pugeo_service.engine import RunRequest, RunResult
from pugeo_service.http.body import Body, ClientDisconnectedError, receive_body
from pugeo_service.http.cancellation import while_connected
from pugeo_service.http.negotiation import OutputChoice, OutputFormat
from pugeo_service.keys import owner_of
from pugeo_service.models import ServedModel
from pugeo_service.observability.tracing import StageSpans
from pugeo_service.problems import ProblemError
from pugeo_service.runs import engine_problems, make_run_request
from pugeo_service.storage.spool import Spool

__all__ = ["serve"]


async def serve(
    request: Request,
    service: Service,
    choice: OutputChoice,
    options: dict[str, Any],
    model: ServedModel,
    deadline: Deadline,
    held: ExitStack,
    *,
    surface_points: int | None = None,
) -> tuple[RunResult, OutputFormat]:
    """Run the point cloud in the body of a request.

    Args:
        request: its body is received here.
        service: runs it.
        choice: of the format of the answer.
        options: keyword arguments of the model's ``Options``.
        model: the model that runs.
        deadline: of the request.
        held: gets the reservation, which then holds the bytes of the answer.
        surface_points: see `RunRequest`.

    Returns:
        The answer and its format.

    Raises:
        ProblemError: the request is refused, or its work failed.
        CloudError: the cloud or an option cannot be used.
        ClientDisconnectedError: the client closed the connection.
    """
    if service.not_ready_because == "no_worker":
        raise ProblemError(
            503,
            "no_worker",
            "No worker is ready yet; try again after the time in Retry-After.",
            retry_after=2,
        )
    reservation = held.enter_context(service.admission.reserve(owner_of(request)))
    try:
        async with deadline.receiving_body():
            body = await receive_body(request, service.settings, reservation)
        with body.spool:
            output = choice.for_input(body.read_as)
            reservation.admit(RunRequest.estimate(body.spool.size, body.format))
            workers = service.engine.status.workers
            reservation.check_deadline(
                deadline.remaining, workers, counted=False, setting=deadline.setting
            )
            result = await _run(
                request,
                service,
                body,
                output,
                options,
                model,
                reservation,
                deadline,
                surface_points,
            )
    except DeadlinePassedError as error:
        service.telemetry.cancelled.labels("deadline").inc()
        detail = f"The request took longer than {deadline.description}."
        fields: dict[str, Any] = {"limit": deadline.seconds}
        if deadline.setting is not None:
            fields["setting"] = deadline.setting
        raise ProblemError(504, "deadline_exceeded", detail, fields=fields) from error
    reservation.hold_answer(result.spool.size)
    return result, output


async def _run(
    request: Request,
    service: Service,
    body: Body[Spool],
    output: OutputFormat,
    options: dict[str, Any],
    model: ServedModel,
    reservation: Reservation,
    deadline: Deadline,
    surface_points: int | None,
) -> RunResult:
    settings = service.settings
    # The limit of the service, not the client's time: a worker that exceeds it is ended.
    run_request = make_run_request(
        settings,
        options,
        model=model.id,
        format=body.format,
        answer=output.name,
        deadline_s=settings.deadline_s,
        surface_points=surface_points,
    )
    abort = asyncio.get_running_loop().create_future()

    def on_patches(count: int) -> None:
        reservation.set_patches(count)
        try:
            workers = service.engine.status.workers
            reservation.check_deadline(
                deadline.remaining, workers, counted=True, setting=deadline.setting
            )
        except ProblemError as problem:
            if not abort.done():
                abort.set_exception(problem)

    spans = StageSpans()
    work = service.engine.run(
        body.spool,
        run_request,
        on_patches=on_patches,
        on_done=reservation.finish,
        on_stage=spans.on_stage,
    )
    seconds = None
    try:
        with engine_problems():
            result = await while_connected(request, work, deadline.remaining, abort)
    except ClientDisconnectedError:
        service.telemetry.cancelled.labels("disconnect").inc()
        raise
    else:
        seconds = result.seconds
        return result
    finally:
        spans.finish(seconds)
