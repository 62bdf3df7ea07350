# SPDX-License-Identifier: Apache-2.0
"""Training: from a folder of meshes to released weights and their model card."""
