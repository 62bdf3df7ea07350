# SPDX-License-Identifier: Apache-2.0
"""The point cloud: input and output of every stage."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Cloud"]


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points with optional normals, colours and scalars.

    Attributes:
        points: ``(M, 3)`` float32 or float64, cloud units, in the file's own frame and precision.
        normals: ``(M, 3)`` float32, or ``None``.
        colors: ``(M, 3)`` RGB or ``(M, 4)`` RGBA uint8, or ``None``.
        scalars: name -> ``(M,)`` numeric array. Floating dtypes are continuous quantities
            (intensity, reflectance), integer dtypes are labels (class, return number).
        notes: sentences for the user about data that a reader guessed or dropped.

    Raises:
        ValueError: an array's shape or dtype is not the one stated above.
    """

    points: NDArray[Any]
    normals: NDArray[np.float32] | None = None
    colors: NDArray[np.uint8] | None = None
    scalars: dict[str, NDArray[Any]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.points)
        if self.points.shape != (count, 3) or self.points.dtype not in (np.float32, np.float64):
            raise ValueError(f"points must be float (M, 3), not {_describe(self.points)}")
        if self.normals is not None and self.normals.shape != (count, 3):
            raise ValueError(f"normals must be ({count}, 3), not {_describe(self.normals)}")
        if self.colors is not None and (
            self.colors.shape not in ((count, 3), (count, 4)) or self.colors.dtype != np.uint8
        ):
            raise ValueError(f"colors must be uint8 ({count}, 3|4), not {_describe(self.colors)}")
        for name, values in self.scalars.items():
            if values.shape != (count,) or values.dtype.kind not in "fiub":
                raise ValueError(f"scalar {name!r} must be ({count},), not {_describe(values)}")

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def join(cls, clouds: "Sequence[Cloud]") -> "Cloud":
        """Concatenate clouds in their order; all have the same attributes as the first."""
        first = clouds[0]

        def joined(get: Callable[[Cloud], Any]) -> Any:
            return None if get(first) is None else np.concatenate([get(cloud) for cloud in clouds])

        return cls(
            points=joined(lambda cloud: cloud.points),
            normals=joined(lambda cloud: cloud.normals),
            colors=joined(lambda cloud: cloud.colors),
            scalars={
                name: np.concatenate([cloud.scalars[name] for cloud in clouds])
                for name in first.scalars
            },
            notes=first.notes,
        )

    def take(self, rows: NDArray[Any]) -> "Cloud":
        """Return the given rows (indices or a mask), in that order, with their attributes."""
        return Cloud(
            points=self.points[rows],
            normals=None if self.normals is None else self.normals[rows],
            colors=None if self.colors is None else self.colors[rows],
            scalars={name: values[rows] for name, values in self.scalars.items()},
            notes=self.notes,
        )


def _describe(array: NDArray[Any]) -> str:
    return f"{array.dtype} {array.shape}"
