# SPDX-License-Identifier: Apache-2.0
"""Names of the package, imported on first use."""

import importlib
import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

import pugeo_model as pm


@pytest.mark.parametrize("name", pm.__all__)
def test_each_name_is_there(name: str) -> None:
    """Each public name is an attribute, and the same object as in its module."""
    value = getattr(pm, name)
    if name in pm._MODULES:
        module = importlib.import_module(f"pugeo_model.{pm._MODULES[name]}")
        assert value is getattr(module, name)


def test_names_are_complete() -> None:
    """``dir`` lists the public names, and each has a module."""
    assert dir(pm) == sorted(pm.__all__)
    assert set(pm._MODULES) == set(pm.__all__) - {"__version__"}


def test_an_unknown_name_is_an_error() -> None:
    """A misspelled name is an AttributeError that names the package."""
    with pytest.raises(AttributeError, match="'pugeo_model' has no attribute 'Upsample'"):
        pm.Upsample  # noqa: B018


def test_threads_of_torch_do_not_wait_in_a_loop() -> None:
    """The policy is set before torch is loaded, unless the user has set another."""
    code = "import os, pugeo_model; print(os.environ['OMP_WAIT_POLICY'])"
    for given, wanted in (({}, "PASSIVE"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE")):
        others = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
        found = subprocess.run(
            [sys.executable, "-c", code],
            env=others | given,
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
        assert found.stdout.strip() == wanted


def test_names_are_imported_on_first_use() -> None:
    """Reading and writing loads no torch; the package itself loads neither numpy nor numba."""
    code = (
        "import sys, pugeo_model as pm; heavy = {'numpy', 'numba', 'scipy', 'torch'}; "
        "print(sorted(heavy & set(sys.modules))); pm.read, pm.write, pm.Cloud; "
        "print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[:2] == ["[]", "False"]


wrong: Any = pm  # its calls have values of wrong types


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (
            lambda cloud: wrong.write("dense.ply", cloud),
            "a Cloud, then a path .* not str and Cloud",
        ),
        (lambda cloud: wrong.write(cloud.points, "dense.ply"), "not ndarray and str"),
        (lambda cloud: wrong.read(cloud.points), "a path or a binary file, not ndarray"),
        (lambda _: wrong.Cloud([[0.0, 0.0, 0.0]]), "points must be a numpy array, not list"),
        (lambda _: wrong.Upsampler()("scan.ply"), r"read it first, with pugeo_model.read\(path\)"),
    ],
)
def test_a_value_of_another_kind_is_named(call: Any, words: str) -> None:
    """Swapped arguments and values of a wrong type get an error that says what is taken."""
    with pytest.raises(TypeError, match=words):
        call(pm.Cloud(np.zeros((3, 3))))
