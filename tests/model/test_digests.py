# SPDX-License-Identifier: Apache-2.0
"""Outputs are bit for bit those that were recorded."""

import json
import sys

import pytest


@pytest.mark.slow
@pytest.mark.parametrize("model", ["standard", "fast"])
def test_answers_stay_the_same_bytes(root, model):
    """Each recorded case gives the recorded bytes."""
    sys.path.insert(0, str(root))
    try:
        from benchmarks.digests import CASES, FILE, digest, platform
    finally:
        sys.path.remove(str(root))
    from pugeo_model.upsampler import Upsampler

    recorded = json.loads(FILE.read_text("utf-8")).get(platform())
    if recorded is None:
        pytest.skip(f"no checksums of {platform()}: record them with make digests")
    upsampler = Upsampler(model)
    wrong = [c for c in CASES if digest(upsampler, c) != recorded[f"{model}: {c}"]]
    assert wrong == []
