# SPDX-License-Identifier: Apache-2.0
"""The untrained network of an architecture, whatever kind it is."""

from typing import Any

from pugeo_model.network.patch_networks import PATCH_NETWORKS, build_patch_network
from pugeo_model.network.pugeo import Architecture, PUGeoNet

__all__ = ["build_network"]


def build_network(architecture: Architecture) -> Any:
    """Return a patch network where the architecture names one, else one that predicts charts."""
    if architecture.backbone in PATCH_NETWORKS:
        return build_patch_network(architecture)
    return PUGeoNet(architecture)
