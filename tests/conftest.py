# SPDX-License-Identifier: Apache-2.0
"""What every test may use."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def root() -> Path:
    """The folder of the repository."""
    return ROOT


@pytest.fixture(scope="session")
def sphere() -> NDArray[np.float32]:
    """600 points spread evenly on the unit sphere: float32 ``(600, 3)``."""
    index = np.arange(600) + 0.5
    polar, azimuth = np.arccos(1 - 2 * index / 600), np.pi * (1 + 5**0.5) * index
    ring = np.sin(polar)
    points = np.stack([np.cos(azimuth) * ring, np.sin(azimuth) * ring, np.cos(polar)], axis=1)
    return points.astype(np.float32)
