# SPDX-License-Identifier: Apache-2.0
"""Requests as data, and answers read: pure functions that both clients share."""

import json
import os
import platform
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypedDict

from pugeo_client._result import Meta
from pugeo_client._source import Body, Source, body_of
from pugeo_client._version import __version__
from pugeo_client.errors import InvalidResponseError, SourceError

__all__ = [
    "Options",
    "Request",
    "base_headers",
    "base_url",
    "default_format",
    "meta_of",
    "read_json",
    "upsample_request",
]

DEFAULT_URL = "http://127.0.0.1:8000"
USER_AGENT = f"pugeo-client/{__version__} (python/{platform.python_version()}; {platform.system()})"
_FORMATS = {
    ".ply": "ply",
    ".npz": "npz",
    ".json": "json",
    ".xyz": "xyz",
    ".txt": "xyz",
}
_XYZ = 3
_DROPPED = "pugeo-dropped-"


@dataclass(frozen=True)
class Request:
    """One HTTP request, before any HTTP library sees it.

    ``awaited``: the service works while the caller waits, so that it should know for how long.
    """

    method: str
    path: str
    params: Mapping[str, str] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    body: Body | None = None
    awaited: bool = False

    @property
    def sendable(self) -> bool:
        """Whether it can be sent (again): false once a pipe was read from."""
        return self.body is None or self.body.sendable


def base_url(given: str | None) -> str:
    """The service's address: as given, else ``PUGEO_URL``, else this machine's port 8000."""
    return (given or os.environ.get("PUGEO_URL") or DEFAULT_URL).rstrip("/")


def base_headers(api_key: str | None) -> dict[str, str]:
    """Headers of every request; the key is the one given, else ``PUGEO_API_KEY``."""
    key = api_key or os.environ.get("PUGEO_API_KEY")
    headers = {"User-Agent": USER_AGENT}
    return {**headers, "Authorization": f"Bearer {key}"} if key else headers


def default_format(out: Path | None) -> str:
    """Choose the answer's format by the extension of the file it goes to."""
    if out is None:
        return "ply"
    suffix = out.suffix.lower()
    if suffix not in _FORMATS:
        known = ", ".join(sorted(_FORMATS))
        raise SourceError(f"no format is known for {out.name}; use one of {known} or say format=")
    return _FORMATS[suffix]


class Options(TypedDict, total=False):
    """What `Client.upsample`, `Client.submit` and their kin take besides the ratio.

    Attributes:
        n_points: exactly so many points, instead of the ratio.
        orient: which side normals face: ``auto``, ``viewpoint``, ``mst``, ``outward``, ``input``
            or ``none``.
        viewpoint: ``(x, y, z)`` that normals face, in the cloud's own frame.
        seed: of the placement; the same seed gives the same cloud.
        keep_input: begin with the input points, untouched and in their order; by default
            noise is smoothed away, and of a clean input those stay that fit an even spread.
    """

    n_points: int | None
    orient: str
    viewpoint: Sequence[float] | None
    seed: int
    keep_input: bool


def upsample_request(
    source: Source,
    ratio: float,
    answer: str,
    *,
    n_points: int | None = None,
    orient: str = "auto",
    viewpoint: Sequence[float] | None = None,
    seed: int = 0,
    keep_input: bool = False,
) -> Request:
    """Build ``POST /upsample``.

    Args:
        source: see `Source`.
        ratio: how many times as many points, 1 to 32. Not sent where ``n_points`` is given.
        answer: format of the answer: ``ply``, ``ply-ascii``, ``npz``, ``json``, ``xyz``.
        n_points: this and the rest: see `Options`.

    Raises:
        SourceError: the source cannot be sent, or the viewpoint is no three numbers.
    """
    params = {"orient": orient, "seed": str(seed), "format": answer}
    if keep_input:
        params["keep_input"] = "true"
    params |= {"R": repr(float(ratio))} if n_points is None else {"n_points": str(n_points)}
    if viewpoint is not None:
        if len(viewpoint) != _XYZ:
            raise SourceError(f"viewpoint must be x, y, z, not {len(viewpoint)} numbers")
        params["viewpoint"] = ",".join(repr(float(value)) for value in viewpoint)
    body = body_of(source)
    headers = {"Content-Type": body.media_type, "Accept-Encoding": "identity"}
    if body.length is not None:
        headers["Content-Length"] = str(body.length)
    return Request("POST", "/upsample", params=params, headers=headers, body=body, awaited=True)


def read_json(body: bytes | None) -> Any:
    """Read a JSON answer.

    Raises:
        InvalidResponseError: it is none.
    """
    try:
        return json.loads(body or b"")
    except ValueError as error:
        raise InvalidResponseError(f"the answer is no JSON: {error}") from error


def meta_of(headers: Mapping[str, str]) -> Meta:
    """Read what the headers of a result say; a header that is not there leaves its default.

    Args:
        headers: by lower-case name.
    """
    dropped = {
        name.removeprefix(_DROPPED).replace("-", "_"): int(value)
        for name, value in headers.items()
        if name.startswith(_DROPPED) and value.isdigit()
    }
    return Meta(
        model_version=headers.get("pugeo-model-version", ""),
        model_sha256=headers.get("pugeo-model-sha256", ""),
        request_id=headers.get("x-request-id", ""),
        points_in=_count(headers.get("pugeo-points-in")),
        points_out=_count(headers.get("pugeo-points-out")),
        dropped=dropped,
        timings=_timings(headers.get("server-timing", "")),
        notes=_notes(headers.get("pugeo-notes", "[]")),
    )


def _count(value: str | None) -> int | None:
    return int(value) if value is not None and value.isdigit() else None


def _timings(server_timing: str) -> dict[str, float]:
    """``infer;dur=12.5, merge;dur=3`` -> seconds by stage."""
    found = re.findall(r"([\w-]+)[^,]*?;\s*dur=([\d.]+)", server_timing)
    return {stage: float(milliseconds) / 1000 for stage, milliseconds in found}


def _notes(value: str) -> tuple[str, ...]:
    try:
        notes = json.loads(value)
    except ValueError:
        return ()
    return tuple(str(note) for note in notes) if isinstance(notes, list) else ()
