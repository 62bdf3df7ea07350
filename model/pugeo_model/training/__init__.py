# SPDX-License-Identifier: Apache-2.0
"""Training of the network on a folder of meshes; produces weights and their model card."""
