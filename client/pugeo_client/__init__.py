# SPDX-License-Identifier: Apache-2.0
"""Python client of a pugeo service for point cloud upsampling.

    import pugeo_client

    dense = pugeo_client.upsample("scan.ply", ratio=8)   # service at PUGEO_URL
    dense.points, dense.normals                          # numpy arrays
    dense.save("dense.ply")

Numpy and the HTTP library are loaded when first used, so that the import of this package is fast.
"""

import importlib
from typing import TYPE_CHECKING, Any

from pugeo_client._version import __version__

if TYPE_CHECKING:
    from pugeo_client import errors
    from pugeo_client._aclient import AsyncClient
    from pugeo_client._client import Client, upsample
    from pugeo_client._requests import Options
    from pugeo_client._result import Meta, Result
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

_MODULES = {
    "AsyncClient": "_aclient",
    "AsyncJob": "jobs",
    "Client": "_client",
    "Job": "jobs",
    "Meta": "_result",
    "Options": "_requests",
    "PugeoError": "errors",
    "Result": "_result",
    "upsample": "_client",
}


def __getattr__(name: str) -> Any:
    if name == "errors":
        return importlib.import_module("pugeo_client.errors")
    if name not in _MODULES:
        raise AttributeError(f"module 'pugeo_client' has no attribute {name!r}")
    return getattr(importlib.import_module(f"pugeo_client.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
