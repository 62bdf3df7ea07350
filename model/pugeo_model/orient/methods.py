# SPDX-License-Identifier: Apache-2.0
"""Names of the orientation methods, and the meaning of ``auto``. Loads neither numba nor scipy."""

from pugeo_model.errors import BadOptionError

__all__ = ["METHODS", "resolve_method"]

METHODS = ("auto", "input", "viewpoint", "mst", "outward", "none")
"""Methods that give normals their signs:

- ``"input"``: the signs of the file's own normals; where these are zero, those of neighbours.
- ``"viewpoint"``: towards a point, such as the position of the scanner.
- ``"outward"``: away from the centroid; correct for convex shapes.
- ``"mst"``: neighbours agree along minimum spanning trees (Hoppe et al. 1992); each connected part
  as a whole outward, or upward if it is flat.
- ``"none"``: unchanged.
- ``"auto"``: ``"input"`` if the file has normals, else ``"viewpoint"`` if one is given, else
  ``"mst"``.
"""


def resolve_method(
    method: str,
    viewpoint: object,
    *,
    has_normals: bool,
) -> str:
    """Return the method that ``"auto"`` stands for; other methods are returned unchanged.

    Args:
        method: one of `METHODS`.
        viewpoint: one or more positions of the scanner, or ``None``.
        has_normals: whether the input has usable normals.

    Raises:
        BadOptionError: ``"input"`` without usable normals.
    """
    if method == "auto":
        without_normals = "viewpoint" if viewpoint is not None else "mst"
        return "input" if has_normals else without_normals
    if method == "input" and not has_normals:
        raise BadOptionError(
            "orient='input' needs a file with usable normals; orient='auto' works without",
            name="orient",
        )
    return method
