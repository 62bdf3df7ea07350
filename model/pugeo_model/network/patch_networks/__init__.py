# SPDX-License-Identifier: Apache-2.0
"""Networks that upsample a patch of N points at once, registered here by name.

Each maps ``(B, N, 3)`` float32 points, centred and of radius 1, to a :class:`PatchOutput` and has
the attributes ``ratio`` and ``architecture``.
"""

from collections.abc import Callable
from typing import Any

from pugeo_model.network.patch_networks.mpu import MPU
from pugeo_model.network.patch_networks.pu_net import PUNet
from pugeo_model.network.patch_networks.pugeo_net import PUGeoNetPaper
from pugeo_model.network.pugeo import Architecture

__all__ = ["PATCH_NETWORKS", "build_patch_network"]

PATCH_NETWORKS: dict[str, Callable[..., Any]] = {
    "pugeo-net": PUGeoNetPaper,
    "pu-net": PUNet,
    "mpu": MPU,
}


def build_patch_network(architecture: Architecture) -> Any:
    """Return the network of an architecture, untrained.

    Args:
        architecture: ``backbone`` is a name in ``PATCH_NETWORKS``; ``options`` are its arguments,
            ``ratio`` among them.
    """
    net = PATCH_NETWORKS[architecture.backbone](
        features=architecture.features, head=architecture.head, **dict(architecture.options)
    )
    net.architecture = architecture
    return net
