# SPDX-License-Identifier: Apache-2.0
"""How good a dense cloud is: distances, evenness, normals, against a reference and a mesh."""
