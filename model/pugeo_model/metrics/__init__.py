# SPDX-License-Identifier: Apache-2.0
"""Quality of dense clouds: distances, evenness and normals, compared with meshes and samples."""
