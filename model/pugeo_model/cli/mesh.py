# SPDX-License-Identifier: Apache-2.0
"""The mesh of ``pugeo upsample --mesh``."""

from pathlib import Path
from typing import Any

from pugeo_model.cli.tasks import needed_extra
from pugeo_model.cloud import Cloud

__all__ = ["check_library", "write_mesh"]


def check_library() -> None:
    """Check that meshes can be made, before the work.

    Raises:
        BadParameter: a library is not installed.
    """
    try:
        from pugeo_model.metrics.reconstruction import library

        library()
    except ModuleNotFoundError as missing:
        raise needed_extra(missing, "surfaces") from missing


def write_mesh(cloud: Cloud, path: Path) -> dict[str, Any]:
    """Reconstruct the surface of a dense cloud and write it.

    Returns:
        ``file``, and the numbers of ``vertices`` and ``faces``.

    Raises:
        CloudError: the normals have no signs, or give no surface.
        OSError: the file cannot be written.
    """
    from pugeo_model.mesh import files
    from pugeo_model.metrics.surface import surface_of

    vertices, faces = surface_of(cloud)
    files.write_mesh(vertices, faces, path)
    return {"file": str(path), "vertices": len(vertices), "faces": len(faces)}
