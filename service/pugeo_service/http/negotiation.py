# SPDX-License-Identifier: Apache-2.0
"""Which format the answer has: ``?format=`` first, then ``Accept`` with its weights."""

from dataclasses import dataclass

from pugeo_model.formats import FORMATS
from pugeo_service.problems import ProblemError

__all__ = ["DEFAULT", "OFFERS", "Offer", "choose"]


@dataclass(frozen=True)
class Offer:
    """A format that answers can have.

    Attributes:
        name: the model's name of the format, and the value of ``?format=``.
        media_types: what an ``Accept`` header may call it; the first is the ``Content-Type``.
        extension: file name ending without the dot.
    """

    name: str
    media_types: tuple[str, ...]
    extension: str

    @property
    def media_type(self) -> str:
        """``Content-Type`` of the answer."""
        return self.media_types[0]


def _offer(name: str) -> Offer:
    module = FORMATS[name]
    further: tuple[str, ...] = ()
    if name == "ply-ascii":
        # Whoever knows PLY by its own types asks for the text form with a parameter.
        further = tuple(f"{kind};format=ascii" for kind in FORMATS["ply"].MEDIA_TYPES)
    extension = (*module.EXTENSIONS, ".ply")[0].removeprefix(".")
    return Offer(name, (*module.MEDIA_TYPES, *further), extension)


# Binary PLY first: it is what wildcards mean.
OFFERS: dict[str, Offer] = {
    name: _offer(name) for name in sorted(FORMATS, key=lambda name: name != "ply")
}
DEFAULT = OFFERS["ply"]
# Ranges with a wildcard and the type of unnamed bytes mean "whatever you like best".
_ANY = frozenset({"*/*", "application/*", "model/*", "application/octet-stream"})


def choose(accept: str | None, wanted: str | None, default: Offer = DEFAULT) -> Offer:
    """Choose the format of an answer.

    Args:
        accept: the ``Accept`` header, or ``None``.
        wanted: the value of ``?format=``, which wins over the header because a link or a
            browser cannot set headers.
        default: what wildcards mean.

    Raises:
        ProblemError: 422 for an unknown ``format``, 406 where no offer suits the header.
    """
    if wanted is not None:
        if wanted not in OFFERS:
            detail = f"format={wanted[:40]!r} is not one of {', '.join(OFFERS)}."
            fields = {"parameter": "format", "value": wanted[:80], "allowed": list(OFFERS)}
            raise ProblemError(422, "bad_option", detail, fields=fields)
        return OFFERS[wanted]
    if accept is None or not accept.strip():
        return default
    for media_range in _ranked(accept):
        if media_range in _ANY:
            return default
        for offer in OFFERS.values():
            if media_range in offer.media_types:
                return offer
        if media_range == "text/*":
            return OFFERS["xyz"]
    offers = [offer.media_type for offer in OFFERS.values()]
    detail = f"No answer suits Accept: {accept[:120]}. Offered: {', '.join(offers)}."
    fields = {"offers": offers, "formats": list(OFFERS)}
    raise ProblemError(406, "not_acceptable", detail, headers={"Vary": "Accept"}, fields=fields)


def _ranked(accept: str) -> list[str]:
    """Return the media ranges of an ``Accept`` header, best first, refused ones left out."""
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
