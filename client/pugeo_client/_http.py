# SPDX-License-Identifier: Apache-2.0
"""The one place that knows which HTTP library is there.

httpx is no longer developed; httpx2 carries its interface on and is what pugeo depends on.
Where an environment pins the older name, that one serves as well.
"""

try:
    import httpx2 as httpx
except ImportError:
    import httpx  # type: ignore[no-redef, import-not-found, unused-ignore]

__all__ = ["httpx"]
