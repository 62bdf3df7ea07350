# SPDX-License-Identifier: Apache-2.0
"""Jobs: requests that continue after their connection, and the process that accepted them."""

from pugeo_service.jobs.manager import JobManager

__all__ = ["JobManager"]
