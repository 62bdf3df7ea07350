# SPDX-License-Identifier: Apache-2.0
"""The settings of a recipe that trains on whole patches, as in section 4.1 of the paper."""

from dataclasses import dataclass, field

__all__ = ["Augmentation", "PatchSettings", "PatchWeights"]


@dataclass(frozen=True)
class Augmentation:
    """Random scaling, rotation and point perturbation (section 4.1, which gives no amounts).

    Attributes:
        scale: a patch is scaled by a factor from ``1 - scale`` to ``1 + scale``.
        rotate: turn every patch by a random rotation.
        jitter: standard deviation of the noise on input points, in patch radii; the spacing of
            256 points is about 0.11. The noise is cut off at three deviations.
    """

    scale: float = 0.2
    rotate: bool = True
    jitter: float = 0.005


@dataclass(frozen=True)
class PatchWeights:
    """Weights of the terms.

    Attributes:
        chamfer: alpha, of the Chamfer distance.
        coarse_normal: beta.
        refined_normal: gamma.
        repulsion: of PU-Net's repulsion loss; PUGeo-Net needs none.
    """

    chamfer: float = 100.0
    coarse_normal: float = 1.0
    refined_normal: float = 1.0
    repulsion: float = 0.0


@dataclass(frozen=True)
class PatchSettings:
    """Patches and loss of a training run.

    Attributes:
        size: points N of a patch.
        batch: patches a step.
        augmentation: of every patch.
        weights: of the joint loss.
    """

    size: int = 256
    batch: int = 8
    augmentation: Augmentation = field(default_factory=Augmentation)
    weights: PatchWeights = field(default_factory=PatchWeights)
