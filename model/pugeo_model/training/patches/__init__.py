# SPDX-License-Identifier: Apache-2.0
"""Training of networks that upsample whole patches: PUGeo-Net as published, PU-Net, MPU."""
