# SPDX-License-Identifier: Apache-2.0
"""Python client of a pugeo service: give it a point cloud, get a denser one.

    import pugeo_client

    dense = pugeo_client.upsample("scan.ply", ratio=8)   # service at PUGEO_URL
    dense.points, dense.normals                          # numpy arrays
    dense.save("dense.ply")

Needs numpy and an HTTP library; both are loaded when first used, so that importing this package
costs next to nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

from pugeo_client._version import __version__

if TYPE_CHECKING:
    from pugeo_client import errors
    from pugeo_client._aclient import AsyncClient
    from pugeo_client._client import Client, upsample
    from pugeo_client._result import Meta, Result
    from pugeo_client._wire import Options
    from pugeo_client.errors import PugeoError
    from pugeo_client.jobs import AsyncJob, Job

__all__ = [
    "AsyncClient",
    "AsyncJob",
    "Client",
    "Job",
    "Meta",
    "Options",
    "PugeoError",
    "Result",
    "__version__",
    "errors",
    "upsample",
]

_HOMES = {
    "AsyncClient": "_aclient",
    "AsyncJob": "jobs",
    "Client": "_client",
    "Job": "jobs",
    "Meta": "_result",
    "Options": "_wire",
    "PugeoError": "errors",
    "Result": "_result",
    "upsample": "_client",
}


def __getattr__(name: str) -> Any:
    if name == "errors":
        return importlib.import_module("pugeo_client.errors")
    if name not in _HOMES:
        raise AttributeError(f"module 'pugeo_client' has no attribute {name!r}")
    return getattr(importlib.import_module(f"pugeo_client.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
