# SPDX-License-Identifier: Apache-2.0
"""Outputs are bit for bit those that were recorded."""

import functools
import json

import pytest

pytest.importorskip("benchmarks", reason="not part of a source distribution")

from benchmarks.digests import CASES, FILE, MODELS, digest, platform

from pugeo_model.upsampler import Upsampler

pytestmark = pytest.mark.slow

upsampler = functools.cache(Upsampler)
"""The upsampler of a model, made once."""


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("model", MODELS)
def test_answers_stay_the_same_bytes(model: str, case: str) -> None:
    """A recorded case gives the recorded bytes."""
    recorded = json.loads(FILE.read_text("utf-8")).get(platform())
    if recorded is None:
        pytest.skip(f"no checksums of {platform()}: record them with make digests")
    assert digest(upsampler(model), case) == recorded[f"{model}: {case}"]
