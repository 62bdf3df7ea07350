# SPDX-License-Identifier: Apache-2.0
"""Jobs: requests that outlive their connection, and the process that accepted them."""

from pugeo_service.jobs.manager import Jobs

__all__ = ["Jobs"]
