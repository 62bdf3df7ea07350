# SPDX-License-Identifier: Apache-2.0
"""The released weights that tests of the engine use."""

from pugeo_model.weights import read_card
from pugeo_service.engine import ModelId

__all__ = ["STANDARD"]

STANDARD = ModelId("standard", read_card("standard")["sha256"])
