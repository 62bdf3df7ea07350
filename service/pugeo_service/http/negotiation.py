# SPDX-License-Identifier: Apache-2.0
"""Choice of the output format: ``?format=``, then ``Accept`` (RFC 9110), then that of the input."""

from dataclasses import dataclass

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
# Media ranges that the format of the input suits, whatever it is.
_ANY = frozenset({"*/*", "application/octet-stream"})
# Fallbacks of the other wildcards: for an input whose format has no such media type.
_WILDCARDS = {"application/*": "ply", "model/*": "ply", "text/*": "xyz"}


@dataclass(frozen=True)
class OutputChoice:
    """The format of an answer, as far as it is known before the input.

    Attributes:
        fixed: the format that the request names; ``None`` if it is that of the input.
        media_range: range that the format of the input must suit, such as ``*/*`` or ``text/*``.
    """

    fixed: OutputFormat | None
    media_range: str = "*/*"

    def for_input(self, read_as: str | None) -> OutputFormat:
        """Return the format of the answer to an input.

        Args:
            read_as: the model's name of the input's format, ``None`` if it is not recognised.
        """
        if self.fixed is not None:
            return self.fixed
        own = OUTPUT_FORMATS[output_format(read_as)]
        if self.media_range in _ANY:
            return own
        prefix = self.media_range.removesuffix("*")
        suits = any(kind.startswith(prefix) for kind in own.media_types)
        return own if suits else OUTPUT_FORMATS[_WILDCARDS[self.media_range]]


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
        return OutputChoice(OUTPUT_FORMATS[wanted])
    if accept is None or not accept.strip():
        return OutputChoice(None)
    for media_range in _ranked(accept):
        if media_range in _ANY or media_range in _WILDCARDS:
            return OutputChoice(None, media_range)
        for output in OUTPUT_FORMATS.values():
            if media_range in output.media_types:
                return OutputChoice(output)
    offers = [output.media_type for output in OUTPUT_FORMATS.values()]
    detail = f"No output format matches Accept: {accept[:120]}. Offered: {', '.join(offers)}."
    fields = {"offers": offers, "formats": list(OUTPUT_FORMATS)}
    raise ProblemError(406, "not_acceptable", detail, headers={"Vary": "Accept"}, fields=fields)


def _ranked(accept: str) -> list[str]:
    """Return the media ranges of an ``Accept`` header, best first, without those of weight 0."""
    weighted: list[tuple[float, bool, int, str]] = []
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
        if kind and weight > 0:
            weighted.append((-weight, "*" in kind, position, kind))
    return [kind for *_, kind in sorted(weighted)]


def _weight(value: str) -> float:
    try:
        return min(1.0, max(0.0, float(value)))
    except ValueError:
        return 0.0
