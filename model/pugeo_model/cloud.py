# SPDX-License-Identifier: Apache-2.0
"""The point cloud: input and output of every stage."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Cloud", "SourceInfo"]


@dataclass(frozen=True, eq=False)
class SourceInfo:
    """Facts about the file of a cloud that belong to no single point.

    Attributes:
        format: key of ``FORMATS`` that the file was read as.
        crs: coordinate reference system as WKT, or ``None``.
        header: data that only the writer of the same format understands, such as a LAS header.
    """

    format: str
    crs: str | None = None
    header: Any = None


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points with optional normals, colours and scalars.

    Attributes:
        points: ``(M, 3)`` float32 or float64, cloud units, in the file's own frame and precision.
        normals: ``(M, 3)`` float32, or ``None``.
        colors: ``(M, 3)`` RGB or ``(M, 4)`` RGBA, uint8 or uint16 (full range), or ``None``.
        scalars: name -> ``(M,)`` numeric array. Integer dtypes are labels (class, return number);
            floating dtypes are continuous quantities (reflectance), except those in ``labels``.
        notes: sentences for the user about everything that a reader guessed or dropped.
        labels: names of floating scalars whose values must not be averaged (GPS time, class).
        viewpoints: ``(S, 3)`` float64 sensor positions in the frame of the points, or ``None``.
            With more than one, the scalar ``scan`` holds the row of each point's own.
        source: facts about the file, or ``None`` for a cloud made in code.

    Raises:
        ValueError: an array's shape or dtype is not the one stated above.
    """

    points: NDArray[Any]
    normals: NDArray[np.float32] | None = None
    colors: NDArray[np.uint8] | NDArray[np.uint16] | None = None
    scalars: dict[str, NDArray[Any]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    labels: frozenset[str] = frozenset()
    viewpoints: NDArray[np.float64] | None = None
    source: SourceInfo | None = None

    def __post_init__(self) -> None:
        arrays = {"points": self.points, "normals": self.normals, "colors": self.colors}
        for name, values in {**arrays, **self.scalars}.items():
            if values is not None and not isinstance(values, np.ndarray):
                raise TypeError(f"{name} must be a numpy array, not {type(values).__name__}")
        count = len(self.points)
        if self.points.shape != (count, 3) or self.points.dtype not in (np.float32, np.float64):
            raise ValueError(f"points must be float (M, 3), not {_describe(self.points)}")
        if self.normals is not None and self.normals.shape != (count, 3):
            raise ValueError(f"normals must be ({count}, 3), not {_describe(self.normals)}")
        if self.colors is not None and (
            self.colors.shape not in ((count, 3), (count, 4))
            or self.colors.dtype not in (np.uint8, np.uint16)
        ):
            raise ValueError(
                f"colors must be uint8 or uint16 ({count}, 3|4), not {_describe(self.colors)}"
            )
        for name, values in self.scalars.items():
            if values.shape != (count,) or values.dtype.kind not in "fiub":
                raise ValueError(f"scalar {name!r} must be ({count},), not {_describe(values)}")

    def __len__(self) -> int:
        return len(self.points)

    @property
    def row_bytes(self) -> int:
        """Bytes of a point with all its attributes."""
        columns = [self.points, self.normals, self.colors, *self.scalars.values()]
        return sum(c.itemsize * (c.size // max(1, len(c))) for c in columns if c is not None)

    @classmethod
    def join(cls, clouds: "Sequence[Cloud]") -> "Cloud":
        """Concatenate clouds in their order; all have the same attributes as the first."""
        first = clouds[0]

        def joined(get: Callable[[Cloud], Any]) -> Any:
            return None if get(first) is None else np.concatenate([get(cloud) for cloud in clouds])

        return replace(
            first,
            points=joined(lambda cloud: cloud.points),
            normals=joined(lambda cloud: cloud.normals),
            colors=joined(lambda cloud: cloud.colors),
            scalars={
                name: np.concatenate([cloud.scalars[name] for cloud in clouds])
                for name in first.scalars
            },
        )

    def take(self, rows: NDArray[Any]) -> "Cloud":
        """Return the given rows (indices or a mask), in that order, with their attributes."""
        return replace(
            self,
            points=self.points[rows],
            normals=None if self.normals is None else self.normals[rows],
            colors=None if self.colors is None else self.colors[rows],
            scalars={name: values[rows] for name, values in self.scalars.items()},
        )


def _describe(array: NDArray[Any]) -> str:
    return f"{array.dtype} {array.shape}"
