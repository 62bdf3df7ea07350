# SPDX-License-Identifier: Apache-2.0
"""Orientation: choice of the sign of normals, within a tile and across tiles."""
