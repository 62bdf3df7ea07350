# SPDX-License-Identifier: Apache-2.0
"""Query parameters of a request: all options with their ranges."""

import math
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from pugeo_service.http.negotiation import OUTPUT_FORMATS

__all__ = ["UpsampleQuery"]

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
            max_length=200,
            description="Position of the scanner as x,y,z in the frame of the cloud.",
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
    format: Annotated[
        str | None,
        Field(
            # The page takes its list of formats from the words before the semicolon.
            description=f"{', '.join(OUTPUT_FORMATS)}; has priority over Accept. "
            "By default the format of the input where it can be written, else ply."
        ),
    ] = None

    @field_validator("viewpoint")
    @classmethod
    def _three_numbers(cls, value: str | None) -> str | None:
        if value is not None:
            _numbers(value)
        return value

    @model_validator(mode="after")
    def _one_size(self) -> Self:
        if self.R is not None and self.n_points is not None:
            raise ValueError("give R or n_points, not both")
        return self

    def for_model(self) -> dict[str, Any]:
        """Return the keyword arguments of the model's ``Options``."""
        return {
            "ratio": _DEFAULT_RATIO if self.R is None else self.R,
            "n_points": self.n_points,
            "orient": self.orient,
            "viewpoint": None if self.viewpoint is None else _numbers(self.viewpoint),
            "seed": self.seed,
            "keep_input": self.keep_input,
        }


def _numbers(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError("must be three numbers such as 0,0,1.7") from None
    if not all(math.isfinite(value) for value in (x, y, z)):
        raise ValueError("must be three finite numbers")
    return x, y, z
