# SPDX-License-Identifier: Apache-2.0
"""The HTTP client of tests that ask a service many times.

``httpx2.get`` reads all certificate authorities of the machine for each request, which takes 30
times as long as the request.
"""

import httpx2

__all__ = ["HTTP"]

HTTP = httpx2.Client(verify=False, limits=httpx2.Limits(max_keepalive_connections=0))
"""Sends each request over a connection of its own, as ``httpx2.get`` does."""
