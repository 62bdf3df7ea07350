# SPDX-License-Identifier: Apache-2.0
"""From new points to a cloud that is worth keeping: attributes and the signs of normals."""
