# SPDX-License-Identifier: Apache-2.0
"""The network: a backbone for features and the four heads of PUGeo-Net for geometry."""
