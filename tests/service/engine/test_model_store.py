# SPDX-License-Identifier: Apache-2.0
"""Weights of a worker that differ from those of the front."""

import pickle

import pytest
from tests.service.engine.standard import STANDARD

from pugeo_service.engine import ModelId, WrongWeightsError
from pugeo_service.engine.model_store import load_model
from pugeo_service.problems import ProblemError
from pugeo_service.runs import engine_problems

WANTED = "ab" * 32


@pytest.mark.parametrize(
    ("name", "found"), [("standard", STANDARD.sha256), ("elsewhere.npz", "none")]
)
def test_other_weights_are_a_problem(name: str, found: str) -> None:
    """The error names both checksums on its way from the worker to the client: a 503."""
    with pytest.raises(WrongWeightsError) as raised:
        load_model(ModelId(name, WANTED))
    # As Dask sends it.
    arrived = pickle.loads(pickle.dumps(raised.value))  # noqa: S301
    assert type(arrived) is WrongWeightsError
    assert str(arrived) == str(raised.value)
    for part in (found[:12], WANTED[:12], repr(name)):
        assert part in str(arrived)
    with pytest.raises(ProblemError) as problem, engine_problems():
        raise arrived
    assert (problem.value.status, problem.value.code) == (503, "wrong_weights")
    assert str(arrived) in problem.value.detail
