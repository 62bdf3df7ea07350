# SPDX-License-Identifier: Apache-2.0
"""The first steps of each process of the service: its settings, its machine, its log."""

import os
import sys
from typing import Any

import structlog
from pydantic import ValidationError

from pugeo_service.observability import logs, tracing
from pugeo_service.preflight import unfit_machine
from pugeo_service.settings import Settings, explain, unknown_names

__all__ = ["begin", "read_settings"]

_log = structlog.stdlib.get_logger("pugeo.service")


def read_settings(given: dict[str, Any]) -> Settings | None:
    """Return these settings over those of the environment.

    ``None`` if one is wrong; a line on stderr then names each wrong one.
    """
    try:
        return Settings(**given)
    except ValidationError as error:
        for line in explain(error):
            sys.stderr.write(line + "\n")
        return None


def begin(settings: Settings, *, computes: bool = True) -> bool:
    """Check the machine, and begin to log.

    Args:
        settings: of the process.
        computes: the process needs worker processes.

    Returns:
        False if something is missing; a line on stderr then says what.
    """
    problem = tracing.missing_extra()
    if computes:
        problem = problem or unfit_machine(settings)
    if problem:
        sys.stderr.write(problem + "\n")
        return False
    logs.configure(settings.log_format, settings.log_level)
    for name, similar in unknown_names(os.environ).items():
        _log.warning("this setting does not exist", name=name, similar=similar)
    return True
