# SPDX-License-Identifier: Apache-2.0
"""Point cloud upsampling with PUGeo-Net's geometry. Importing this package imports no torch."""

from pugeo_model.cloud import Cloud
from pugeo_model.errors import (
    BadOptionError,
    CloudError,
    LimitExceededError,
    MalformedFileError,
    UnsupportedFormatError,
    UntreatableCloudError,
)

__all__ = [
    "BadOptionError",
    "Cloud",
    "CloudError",
    "LimitExceededError",
    "MalformedFileError",
    "UnsupportedFormatError",
    "UntreatableCloudError",
]
__version__ = "0.1.0"
