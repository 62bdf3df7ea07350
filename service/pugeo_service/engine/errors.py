# SPDX-License-Identifier: Apache-2.0
"""What can go wrong in the engine that is no fault of the points themselves."""

__all__ = ["EngineLost", "WorkerLost"]


class WorkerLost(Exception):
    """A task ended its worker process twice: out of memory, out of time, or a crash."""


class EngineLost(Exception):
    """The scheduler or all results on it are gone."""
