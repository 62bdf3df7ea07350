# SPDX-License-Identifier: Apache-2.0
"""The query of a request: every option, its range, and no others."""

import math
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator
from pydantic_core import PydanticCustomError

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
            description="How normals are oriented: auto, input, viewpoint, mst, outward or none.",
        ),
    ] = "auto"
    viewpoint: Annotated[
        str | None,
        Field(
            max_length=200,
            description="Where the scanner stood, as x,y,z in the cloud's frame.",
            examples=["0,0,1.7"],
        ),
    ] = None
    seed: Annotated[int, Field(ge=0, lt=2**63, description="Same seed, same points.")] = 0
    keep_input: Annotated[
        bool,
        Field(
            description="Begin with the cleaned input points, untouched and in their order; "
            "else noise is smoothed away, and of clean input those stay that fit an even spread."
        ),
    ] = False
    format: Annotated[
        str | None,
        Field(description="ply, ply-ascii, npz, json or xyz; wins over the Accept header."),
    ] = None

    @model_validator(mode="before")
    @classmethod
    def _known(cls, given: Any) -> Any:
        unknown = sorted(set(given) - set(cls.model_fields)) if isinstance(given, dict) else []
        if unknown:
            raise PydanticCustomError(
                "unknown_option",
                "there is no option {parameter}; there are {names}",
                {
                    "parameter": unknown[0][:80],
                    "names": ", ".join(cls.model_fields),
                    "allowed": list(cls.model_fields),
                },
            )
        return given

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
