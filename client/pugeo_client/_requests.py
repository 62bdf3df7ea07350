# SPDX-License-Identifier: Apache-2.0
"""Requests as data: pure functions for both clients."""

import operator
import os
import platform
import re
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypedDict
from urllib.parse import quote

import numpy as np

from pugeo_client._source import Body, Source, make_body
from pugeo_client._version import __version__
from pugeo_client.errors import ConfigurationError, SourceError

__all__ = [
    "Options",
    "Request",
    "address",
    "base_headers",
    "format_of",
    "job_request",
    "list_request",
    "submit_request",
    "upsample_request",
]

DEFAULT_URL = "http://127.0.0.1:8000"
DEFAULT_RATIO = 4
USER_AGENT = f"pugeo-client/{__version__} (python/{platform.python_version()}; {platform.system()})"
_FORMATS = {
    "ply": ".ply",
    "npz": ".npz",
    "npy": ".npy",
    "las": ".las",
    "laz": ".laz",
    "e57": ".e57",
    "pcd": ".pcd",
    "ptx": ".ptx",
    "json": ".json",
    "xyz": ".xyz .pts .txt .csv .asc .xyzn .xyzrgb .neu .dat",
}
EXTENSIONS = {end: name for name, endings in _FORMATS.items() for end in endings.split()}
"""File extension -> format of the answer."""
_VISIBLE = re.compile(r"[\x21-\x7e]+")
_KEY = re.compile(r"[\x21-\x7e]([\x20-\x7e]{0,253}[\x21-\x7e])?")
# A compressed answer would cost time, and could unpack to any size.
_UNCOMPRESSED = {"Accept-Encoding": "identity"}


@dataclass(frozen=True)
class Request:
    """One HTTP request, independent of the HTTP library.

    Attributes:
        method: of HTTP.
        path: after the base URL, already percent-encoded.
        params: of the query.
        headers: on top of those of every request.
        body: or None.
        timed: send the time left in ``Prefer: wait``, so that the service can give up in time.
    """

    method: str
    path: str
    params: Mapping[str, str] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    body: Body | None = None
    timed: bool = False

    @property
    def sendable(self) -> bool:
        """True while the whole body can be sent (again); false once a pipe was read."""
        return self.body is None or self.body.sendable


def address(given: str | None) -> str:
    """Return the address of the service: the one given, else ``PUGEO_URL``, else the default."""
    return given or os.environ.get("PUGEO_URL") or DEFAULT_URL


def base_headers(api_key: str | None) -> dict[str, str]:
    """Return the headers of every request.

    Args:
        api_key: sent as a bearer token; ``PUGEO_API_KEY`` by default.

    Raises:
        ConfigurationError: the key has spaces, line ends or other characters beyond visible
            ASCII. The message does not quote the key.
    """
    key = api_key or os.environ.get("PUGEO_API_KEY")
    headers = {"User-Agent": USER_AGENT, **_UNCOMPRESSED}
    if not key:
        return headers
    if not _VISIBLE.fullmatch(key):
        raise ConfigurationError(
            "the API key has characters that a header cannot carry, such as a space or a line "
            "end; if it was read from a file, strip() it"
        )
    return {**headers, "Authorization": f"Bearer {key}"}


def format_of(out: Path | None) -> str:
    """Return the format for an output file by its extension; PLY for memory.

    Raises:
        SourceError: the extension belongs to no format.
    """
    if out is None:
        return "ply"
    suffix = out.suffix.lower()
    if suffix not in EXTENSIONS:
        known = ", ".join(sorted(EXTENSIONS))
        raise SourceError(f"no format is known for {out.name}; use one of {known} or say format=")
    return EXTENSIONS[suffix]


class Options(TypedDict, total=False):
    """Options of `Client.upsample`, `Client.submit` and `Client.map`.

    Attributes:
        R: another name of ``ratio``, as in the paper and in the REST service.
        n_points: exact number of output points, instead of a ratio.
        orient: rule for the sign of the normals: ``auto``, ``viewpoint``, ``mst``, ``outward``,
            ``input`` or ``none``.
        viewpoint: ``(x, y, z)`` that normals face, in the frame and units of the cloud, or
            several such positions of a scanner.
        seed: of the point placement; the same seed gives the same cloud.
        keep_input: the output begins with the input points, unchanged and in their order. By
            default noise is smoothed away, and input points stay where they fit an even spacing.
        density: ``input``, as dense as the scan is at each place, or ``even``, one spacing over
            the whole surface.
        spacing: mean distance of neighbouring output points in the units of the cloud, instead of
            a ratio; means density ``even``.
        max_gap: largest distance of an output point from the input, in the units of the cloud.
        denoise: with ratio 1, the input points are moved onto the surface.
        confidence: the answer has the scalar ``expected_error``: the distance from the true surface
            that is expected of each point, in the units of the cloud.
        model: name of a model of the service, see `Client.models`; its default by default.
    """

    R: float | None
    n_points: int | None
    orient: str
    viewpoint: Sequence[float] | Sequence[Sequence[float]] | None
    seed: int
    keep_input: bool
    density: str
    spacing: float | None
    max_gap: float | None
    denoise: bool
    confidence: bool
    model: str | None


def upsample_request(
    source: Source,
    ratio: float | None,
    format: str,
    *,
    R: float | None = None,
    n_points: int | None = None,
    orient: str = "auto",
    viewpoint: Sequence[float] | Sequence[Sequence[float]] | None = None,
    seed: int = 0,
    keep_input: bool = False,
    density: str = "input",
    spacing: float | None = None,
    max_gap: float | None = None,
    denoise: bool = False,
    confidence: bool = False,
    model: str | None = None,
) -> Request:
    """Build ``POST /upsample``.

    Args:
        source: see `Source`.
        ratio: number of output points per input point, 1 to 32; 4 by default.
        format: of the answer, such as ``ply``, ``ply-ascii`` or ``laz``.
        R: this and the following: see `Options`.

    Raises:
        SourceError: the source cannot be sent, an option is no number, or more than one of
            ``ratio``, ``R``, ``n_points`` and ``spacing`` is given.
    """
    params = {"orient": str(orient), "seed": str(_whole("seed", seed)), "format": format}
    params |= _number_of_points(ratio, R, n_points, spacing)
    switches = {"keep_input": keep_input, "denoise": denoise, "confidence": confidence}
    params |= {name: "true" for name, value in switches.items() if value}
    if model is not None:
        params["model"] = str(model)
    if density != "input":
        params["density"] = str(density)
    if max_gap is not None:
        params["max_gap"] = repr(_number("max_gap", max_gap))
    if viewpoint is not None:
        positions = [",".join(map(repr, position)) for position in _positions(viewpoint)]
        params["viewpoint"] = ";".join(positions)
    body = make_body(source)
    headers = {"Content-Type": body.media_type}
    if body.length is not None:
        headers["Content-Length"] = str(body.length)
    return Request("POST", "/upsample", params=params, headers=headers, body=body, timed=True)


def submit_request(upsample: Request, key: str | None, webhook: str | None) -> Request:
    """Turn the request of an upsampling into that of a job.

    Args:
        upsample: result of `upsample_request`.
        key: ``Idempotency-Key``: a repeated request with the same key makes no second job. By
            default a random one, which covers the retries of one call.
        webhook: address that gets a signed POST when the job has ended, or ``None``.

    Raises:
        SourceError: the key is not 1 to 255 printable ASCII characters.
    """
    if key is not None and not _KEY.fullmatch(key):
        raise SourceError("idempotency_key must be 1 to 255 printable ASCII characters")
    headers = {**upsample.headers, "Idempotency-Key": key or secrets.token_hex(16)}
    params = dict(upsample.params) | ({} if webhook is None else {"webhook": webhook})
    return replace(upsample, path="/jobs", params=params, headers=headers, timed=False)


def job_request(method: str, job_id: str, path: str = "") -> Request:
    """Build a request about one job.

    Args:
        method: of HTTP.
        job_id: any string; it is percent-encoded.
        path: below the job, such as ``/result``.

    Raises:
        SourceError: the id is empty, or one that a URL cannot carry.
    """
    if job_id in {"", ".", ".."}:
        raise SourceError(f"{job_id!r} is no id of a job")
    return Request(method, f"/jobs/{quote(job_id, safe='')}{path}")


def list_request(state: str | None, cursor: str | None) -> Request:
    """Build the request for one page of jobs."""
    params = {"limit": "100"}
    params |= {} if state is None else {"state": state}
    params |= {} if cursor is None else {"cursor": cursor}
    return Request("GET", "/jobs", params=params)


def _number_of_points(
    ratio: float | None, R: float | None, n_points: int | None, spacing: float | None
) -> dict[str, str]:
    named = {"ratio": ratio, "R": R, "n_points": n_points, "spacing": spacing}
    given = [name for name, value in named.items() if value is not None]
    if len(given) > 1:
        raise SourceError(
            f"give only one of ratio, R, n_points and spacing, not {' and '.join(given)}"
        )
    if spacing is not None:
        return {"spacing": repr(_number("spacing", spacing))}
    if n_points is not None:
        return {"n_points": str(_whole("n_points", n_points))}
    value = R if ratio is None else ratio
    try:
        return {"R": repr(float(DEFAULT_RATIO if value is None else value))}
    except (TypeError, ValueError) as error:
        raise SourceError(f"the ratio must be a number from 1 to 32, not {value!r}") from error


def _number(name: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise SourceError(f"{name} must be a number, not {value!r}") from error


def _whole(name: str, value: Any) -> int:
    """Return a whole number; a float such as ``1e5`` counts as one."""
    try:
        return int(value) if float(value).is_integer() else operator.index(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise SourceError(f"{name} must be a whole number, not {value!r}") from error


def _positions(viewpoint: Any) -> list[list[float]]:
    try:
        positions = np.asarray(viewpoint, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise SourceError(f"viewpoint must be x, y, z, not {viewpoint!r}") from error
    if positions.shape == (3,):
        positions = positions[None]
    if positions.ndim != 2 or positions.shape[1] != 3 or not len(positions):
        raise SourceError(
            f"viewpoint must be x, y, z, or several such, not numbers of shape {positions.shape}"
        )
    rows: list[list[float]] = positions.tolist()
    return rows
