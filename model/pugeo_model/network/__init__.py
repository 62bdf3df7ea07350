# SPDX-License-Identifier: Apache-2.0
"""The network: a backbone for features, PUGeo's four heads for geometry. Pure torch, float32."""
