# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes: sampling them and measuring distances to them."""
