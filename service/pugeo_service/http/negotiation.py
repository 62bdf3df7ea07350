# SPDX-License-Identifier: Apache-2.0
"""Choice of the output format: ``?format=``, then ``Accept`` (RFC 9110), then that of the input."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from pugeo_model.formats import WRITABLE, output_format
from pugeo_service.problems import ProblemError

__all__ = ["OUTPUT_FORMATS", "OutputChoice", "OutputFormat", "choose_format"]


@dataclass(frozen=True)
class OutputFormat:
    """A format of answers.

    Attributes:
        name: the model's name of the format, and the value of ``?format=``.
        media_types: names in ``Accept`` headers; the first is the ``Content-Type``.
        extension: suffix of file names, without the dot.
    """

    name: str
    media_types: tuple[str, ...]
    extension: str

    @property
    def media_type(self) -> str:
        """``Content-Type`` of the answer."""
        return self.media_types[0]


def _output_format(name: str) -> OutputFormat:
    module = WRITABLE[name]
    further: tuple[str, ...] = ()
    if name == "ply-ascii":
        # The media types of PLY with a parameter name the text form.
        further = tuple(f"{kind};format=ascii" for kind in WRITABLE["ply"].MEDIA_TYPES)
    extension = (*module.EXTENSIONS, ".ply")[0].removeprefix(".")
    return OutputFormat(name, (*module.MEDIA_TYPES, *further), extension)


# Binary PLY is first, as the choice where the format of the input cannot be written.
OUTPUT_FORMATS: dict[str, OutputFormat] = {
    name: _output_format(name) for name in sorted(WRITABLE, key=lambda name: name != "ply")
}
# The media type of any bytes, which every format suits.
_BYTES = "application/octet-stream"
# Choices for an input whose own format does not suit: PLY, or XYZ where only text does.
_COMMON = frozenset({"ply", "xyz"})


@dataclass(frozen=True)
class OutputChoice:
    """The formats that an answer may have, as far as they are known before the input.

    Attributes:
        allowed: at least one format; the first is for an input whose own format is not among them.
    """

    allowed: tuple[OutputFormat, ...]

    def for_input(self, read_as: str | None) -> OutputFormat:
        """Return the format of the answer to an input.

        Args:
            read_as: the model's name of the input's format, ``None`` if it is not recognised.
        """
        own = OUTPUT_FORMATS[output_format(read_as)]
        return own if own in self.allowed else self.allowed[0]


def choose_format(accept: str | None, wanted: str | None) -> OutputChoice:
    """Choose the format of an answer.

    Without ``format`` and without a media type in ``Accept`` it is the format of the input.

    Args:
        accept: the ``Accept`` header, or ``None``.
        wanted: the value of ``?format=``. It has priority, because a link cannot set headers.

    Raises:
        ProblemError: 422 for an unknown ``format``, 406 if no format matches the header.
    """
    if wanted is not None:
        if wanted not in OUTPUT_FORMATS:
            detail = f"format={wanted[:40]!r} is not one of {', '.join(OUTPUT_FORMATS)}."
            fields = {"parameter": "format", "value": wanted[:80], "allowed": list(OUTPUT_FORMATS)}
            raise ProblemError(422, "bad_option", detail, fields=fields)
        return OutputChoice((OUTPUT_FORMATS[wanted],))
    outputs = sorted(OUTPUT_FORMATS.values(), key=lambda output: output.name not in _COMMON)
    if accept is None or not accept.strip():
        return OutputChoice(tuple(outputs))
    ranges = _parsed(accept)
    ranks = {output.name: _rank(output, ranges) for output in outputs}
    best = max(ranks.values())
    if best.weight > 0:
        return OutputChoice(tuple(output for output in outputs if ranks[output.name] == best))
    offers = [output.media_type for output in OUTPUT_FORMATS.values()]
    detail = f"No output format matches Accept: {accept[:120]}. Offered: {', '.join(offers)}."
    fields = {"offers": offers, "formats": list(OUTPUT_FORMATS)}
    raise ProblemError(406, "not_acceptable", detail, headers={"Vary": "Accept"}, fields=fields)


class _Rank(NamedTuple):
    """Preference for a media range; the larger one wins.

    Attributes:
        weight: 0 to 1; a weight of 0 excludes the media types of the range.
        precision: 2 for a media type, 1 for ``type/*``, 0 for ``*/*``.
        order: the negative position in the header.
    """

    weight: float
    precision: int
    order: int


_EXCLUDED = _Rank(0.0, 0, 0)


def _rank(output: OutputFormat, ranges: Mapping[str, _Rank]) -> _Rank:
    """Return the rank of a format: that of the most specific range that matches one of its names.

    A name that is excluded excludes the format, unless another of its names is listed.
    """
    named = [ranges[kind] for kind in output.media_types if kind in ranges]
    if named and max(named).weight == 0:
        return _EXCLUDED
    if _BYTES in ranges and ranges[_BYTES].weight > 0:
        named.append(ranges[_BYTES])
    if named:
        return max(named)
    served, *others = (_wildcard(kind, ranges) for kind in output.media_types)
    # A range that excludes the Content-Type of the answer excludes it under each of its names.
    if served is not None and served.weight == 0:
        return _EXCLUDED
    return max((found for found in (served, *others) if found is not None), default=_EXCLUDED)


def _wildcard(kind: str, ranges: Mapping[str, _Rank]) -> _Rank | None:
    """Return the rank of the most specific wildcard that matches a media type, if there is one."""
    return ranges.get(f"{kind.partition('/')[0]}/*", ranges.get("*/*"))


def _parsed(accept: str) -> dict[str, _Rank]:
    """Return the media ranges of an ``Accept`` header; of a repeated one, the best rank."""
    ranges: dict[str, _Rank] = {}
    for position, item in enumerate(accept.split(",")):
        kind, *parameters = (part.strip().lower() for part in item.split(";"))
        weight = 1.0
        for parameter in parameters:
            name, _, value = parameter.partition("=")
            if name.strip() == "q":
                weight = _weight(value.strip())
            elif name.strip() == "format":
                plain = value.strip().strip('"')
                kind = f"{kind};format={plain}"
        precision = 2 - kind.count("*")
        ranges[kind] = max(ranges.get(kind, _EXCLUDED), _Rank(weight, precision, -position))
    return ranges


def _weight(value: str) -> float:
    try:
        return min(1.0, max(0.0, float(value)))
    except ValueError:
        return 0.0
