# SPDX-License-Identifier: Apache-2.0
"""The output of networks that upsample a patch of points at once."""

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

__all__ = ["LocalGeometry", "PatchOutput"]


@dataclass(frozen=True, eq=False)
class LocalGeometry:
    """The learned local parameterization of PUGeo-Net, for its verification.

    Attributes:
        uv: ``(B, N, R, 2)`` adaptive samples in the parametric domain.
        T: ``(B, N, 3, 3)`` augmented Jacobian, columns ``t1, t2, t3``.
        displacement: ``(B, N, R)`` along ``t3``.
    """

    uv: Tensor
    T: Tensor
    displacement: Tensor


@dataclass(frozen=True, eq=False)
class PatchOutput:
    """Points of a batch of patches, in the frame and scale of the input; all float32.

    Attributes:
        points: ``(B, N, R, 3)``, the samples of every input point.
        normals: ``(B, N, R, 3)`` unit, unoriented; ``None`` from networks without normals.
        coarse_normals: ``(B, N, 3)`` unit normals of the input points; ``None`` as above.
        geometry: of PUGeo-Net alone.
    """

    points: Tensor
    normals: Tensor | None = None
    coarse_normals: Tensor | None = None
    geometry: LocalGeometry | None = None

    def unflatten(self, batch: int, count: int) -> "PatchOutput":
        """The output of ``batch * count`` points as that of ``batch`` patches."""

        def shaped(values: Tensor) -> Tensor:
            split: Tensor = values.unflatten(0, (batch, count))
            return split

        return self._mapped(shaped, shaped, shaped)

    def turned(self, axes: Tensor) -> "PatchOutput":
        """Return the output of patches ``p`` from that of ``p @ axes.mT``.

        Args:
            axes: ``(B, 3, 3)`` rotations.
        """

        def back(vectors: Tensor) -> Tensor:
            turned: Tensor = vectors.flatten(1, -2) @ axes
            split: Tensor = turned.unflatten(1, vectors.shape[1:-1])
            return split

        return self._mapped(back, lambda T: axes.mT.unsqueeze(1) @ T, lambda scalars: scalars)

    def _mapped(
        self,
        vectors: Callable[[Tensor], Tensor],
        matrices: Callable[[Tensor], Tensor],
        scalars: Callable[[Tensor], Tensor],
    ) -> "PatchOutput":
        """Apply a function to each kind of tensor."""
        geometry = self.geometry
        if geometry is not None:
            geometry = LocalGeometry(
                scalars(geometry.uv), matrices(geometry.T), scalars(geometry.displacement)
            )
        return PatchOutput(
            vectors(self.points),
            None if self.normals is None else vectors(self.normals),
            None if self.coarse_normals is None else vectors(self.coarse_normals),
            geometry,
        )
