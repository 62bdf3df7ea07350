# SPDX-License-Identifier: Apache-2.0
"""Query parameters of a request: all options with their ranges."""

import math
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from pugeo_service.http.negotiation import OUTPUT_FORMATS

__all__ = ["JobQuery", "UpsampleQuery"]

_DEFAULT_RATIO = 4.0


class UpsampleQuery(BaseModel):
    """Options of ``POST /upsample``."""

    model_config = ConfigDict(extra="forbid")

    R: Annotated[
        float | None,
        Field(
            ge=1,
            le=32,
            allow_inf_nan=False,
            description="Points out for each point in, any real number; 4 by default. "
            "1 returns the input's points with normals.",
            examples=[8],
        ),
    ] = None
    n_points: Annotated[
        int | None, Field(ge=1, description="Points out, instead of R.", examples=[100000])
    ] = None
    spacing: Annotated[
        float | None,
        Field(
            gt=0,
            allow_inf_nan=False,
            description="Mean distance of neighbouring points, in units of the cloud, instead of "
            "R; means density=even.",
            examples=[0.01],
        ),
    ] = None
    density: Annotated[
        Literal["input", "even"],
        Field(
            description="input: as dense as the scan is at each place; even: one spacing over the "
            "whole surface."
        ),
    ] = "input"
    max_gap: Annotated[
        float | None,
        Field(
            gt=0,
            allow_inf_nan=False,
            description="Largest distance of a point from the input, in units of the cloud; by "
            "default 1.25 local spacings.",
        ),
    ] = None
    denoise: Annotated[
        bool,
        Field(
            description="With R=1: move the input's points onto the surface; they keep their "
            "order and attributes."
        ),
    ] = False
    confidence: Annotated[
        bool,
        Field(
            description="Add the scalar expected_error: the distance from the true surface that "
            "is expected of each point, in units of the cloud."
        ),
    ] = False
    orient: Annotated[
        str,
        Field(
            max_length=32,
            description="Orientation of normals: auto, input, viewpoint, mst, outward or none.",
        ),
    ] = "auto"
    viewpoint: Annotated[
        str | None,
        Field(
            max_length=4000,
            description="Position of the scanner as x,y,z in the frame of the cloud; several "
            "positions are separated by semicolons.",
            examples=["0,0,1.7"],
        ),
    ] = None
    seed: Annotated[
        int, Field(ge=0, lt=2**63, description="The same seed gives the same points.")
    ] = 0
    keep_input: Annotated[
        bool,
        Field(
            description="Start the answer with the cleaned input points, unchanged and in order. "
            "Otherwise noisy input points are replaced, and of clean ones those are kept that fit "
            "an even spacing."
        ),
    ] = False
    model: Annotated[
        str | None,
        Field(
            max_length=128,
            description="Name of a model of GET /models; the default of the service if unset.",
        ),
    ] = None
    format: Annotated[
        str | None,
        Field(
            description=f"{', '.join(OUTPUT_FORMATS)}; has priority over Accept. "
            "By default the format of the input where it can be written, else ply."
        ),
    ] = None

    @field_validator("viewpoint")
    @classmethod
    def _three_numbers(cls, value: str | None) -> str | None:
        if value is not None:
            _positions(value)
        return value

    @model_validator(mode="after")
    def _one_size(self) -> Self:
        given = [name for name in ("R", "n_points", "spacing") if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"give {given[0]} or {given[1]}, not both")
        return self

    def for_model(self) -> dict[str, Any]:
        """Return the keyword arguments of the model's ``Options``."""
        return {
            "ratio": _DEFAULT_RATIO if self.R is None else self.R,
            "n_points": self.n_points,
            "orient": self.orient,
            "viewpoint": None if self.viewpoint is None else _positions(self.viewpoint),
            "seed": self.seed,
            "keep_input": self.keep_input,
            "density": self.density,
            "spacing": self.spacing,
            "max_gap": self.max_gap,
            "denoise": self.denoise,
            "confidence": self.confidence,
        }


class JobQuery(UpsampleQuery):
    """Options of ``POST /jobs``."""

    webhook: Annotated[
        str | None,
        Field(
            max_length=2000,
            description="URL that gets a signed POST when the job has ended.",
            examples=["https://example.org/pugeo"],
        ),
    ] = None


def _positions(text: str) -> tuple[tuple[float, float, float], ...]:
    return tuple(_numbers(part) for part in text.split(";"))


def _numbers(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError("must be three numbers such as 0,0,1.7") from None
    if not all(math.isfinite(value) for value in (x, y, z)):
        raise ValueError("must be three finite numbers")
    return x, y, z
