# SPDX-License-Identifier: Apache-2.0
"""Names of the orientation methods and the meaning of ``auto``."""

import pytest

from pugeo_model import BadOptionError
from pugeo_model.orient.methods import METHODS, resolve_method

VIEWPOINT = (0.0, 0.0, 9.0)


def test_auto_uses_the_available_data() -> None:
    """The file's normals come first, then a viewpoint, then spanning trees."""
    assert resolve_method("auto", VIEWPOINT, has_normals=True) == "input"
    assert resolve_method("auto", VIEWPOINT, has_normals=False) == "viewpoint"
    assert resolve_method("auto", None, has_normals=False) == "mst"


@pytest.mark.parametrize("method", [each for each in METHODS if each != "auto"])
def test_other_methods_are_unchanged(method: str) -> None:
    """A method that is given explicitly is used, whatever data there is."""
    assert resolve_method(method, VIEWPOINT, has_normals=True) == method


def test_input_needs_normals() -> None:
    """``input`` without usable normals is an error that names the option."""
    with pytest.raises(BadOptionError, match="usable normals") as caught:
        resolve_method("input", None, has_normals=False)
    assert caught.value.fields["name"] == "orient"
