# SPDX-License-Identifier: Apache-2.0
"""Dense clouds that another program made, as a method of a table.

A file's name is a hash of the input's points: so a cloud is only ever taken for its own input.
"""

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pugeo_model.cloud import Cloud
from pugeo_model.formats import read

__all__ = ["stored", "stored_path"]


def stored_path(folder: Path, cloud: Cloud) -> Path:
    """Path of the dense cloud of an input."""
    digest = hashlib.sha256(np.ascontiguousarray(cloud.points, dtype=np.float64).tobytes())
    return folder / f"{digest.hexdigest()[:16]}.ply"


def stored(folder: Path) -> Callable[[Cloud, float], Cloud]:
    """A method that gives the stored cloud of every input.

    The method raises:
        FileNotFoundError: the folder has none for this input.
    """

    def method(cloud: Cloud, _ratio: float) -> Cloud:
        path = stored_path(folder, cloud)
        if not path.exists():
            raise FileNotFoundError(f"{folder} has no dense cloud of this input ({path.name})")
        return read(path)

    return method
