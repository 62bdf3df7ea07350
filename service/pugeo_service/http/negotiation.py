# SPDX-License-Identifier: Apache-2.0
"""Choice of the output format: ``?format=`` first, then ``Accept`` with its weights (RFC 9110)."""

from collections.abc import Mapping
from dataclasses import dataclass

from pugeo_model.formats import WRITABLE
from pugeo_service.problems import ProblemError

__all__ = ["DEFAULT", "OUTPUT_FORMATS", "OutputFormat", "choose_format", "negotiate"]


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


# Binary PLY is first, as the choice for wildcards.
OUTPUT_FORMATS: dict[str, OutputFormat] = {
    name: _output_format(name) for name in sorted(WRITABLE, key=lambda name: name != "ply")
}
DEFAULT = OUTPUT_FORMATS["ply"]
# Media ranges for which the default is chosen.
_ANY = frozenset({"*/*", "application/*", "model/*", "application/octet-stream"})


def negotiate(headers: Mapping[str, str], wanted: str | None) -> OutputFormat:
    """Choose the format of an answer by the headers of its request and ``?format=``.

    JSON in means JSON out unless ``Accept`` names another format.

    Raises:
        ProblemError: see `choose_format`.
    """
    kind = headers.get("content-type", "").partition(";")[0].strip().lower()
    default = OUTPUT_FORMATS["json"] if kind == "application/json" else DEFAULT
    return choose_format(headers.get("accept"), wanted, default)


def choose_format(
    accept: str | None, wanted: str | None, default: OutputFormat = DEFAULT
) -> OutputFormat:
    """Choose the format of an answer.

    Args:
        accept: the ``Accept`` header, or ``None``.
        wanted: the value of ``?format=``. It has priority, because a link cannot set headers.
        default: choice for wildcards.

    Raises:
        ProblemError: 422 for an unknown ``format``, 406 if no format matches the header.
    """
    if wanted is not None:
        if wanted not in OUTPUT_FORMATS:
            detail = f"format={wanted[:40]!r} is not one of {', '.join(OUTPUT_FORMATS)}."
            fields = {"parameter": "format", "value": wanted[:80], "allowed": list(OUTPUT_FORMATS)}
            raise ProblemError(422, "bad_option", detail, fields=fields)
        return OUTPUT_FORMATS[wanted]
    if accept is None or not accept.strip():
        return default
    for media_range in _ranked(accept):
        if media_range in _ANY:
            return default
        for output in OUTPUT_FORMATS.values():
            if media_range in output.media_types:
                return output
        if media_range == "text/*":
            return OUTPUT_FORMATS["xyz"]
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
