# SPDX-License-Identifier: Apache-2.0
"""Networks of a worker process by the sha256 of their weights.

Released weights are part of the package, so each worker has them. Others are sent once by the
front: see `model_plugin`. A request names both, so that workers never answer with other weights
than the front says.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

from pugeo_service.engine.errors import WrongWeightsError
from pugeo_service.engine.messages import ModelId

if TYPE_CHECKING:
    from pugeo_model.local_stages import Network
    from pugeo_model.weights import Weights

__all__ = ["install", "load_model", "remove"]

_KEPT = 8  # networks; each has some MB

# Weights that fronts have sent, and the number of fronts that did.
_sent: dict[str, tuple[Weights, int]] = {}


def install(weights: Weights) -> None:
    """Keep weights that a front has sent."""
    sha256 = weights.card["sha256"]
    _, fronts = _sent.get(sha256, (weights, 0))
    _sent[sha256] = (weights, fronts + 1)


def remove(sha256: str) -> None:
    """Forget weights once each front that sent them has called this."""
    if sha256 in _sent:
        weights, fronts = _sent.pop(sha256)
        if fronts > 1:
            _sent[sha256] = (weights, fronts - 1)


@functools.lru_cache(maxsize=_KEPT)
def load_model(model: ModelId) -> Network:
    """Return the network of a model, built once.

    Raises:
        WrongWeightsError: this worker has other weights of that name, or none.
        BadOptionError: they are damaged.
    """
    from pugeo_model import weights
    from pugeo_model.errors import BadOptionError

    if model.sha256 in _sent:
        found = _sent[model.sha256][0]
    else:
        try:
            found = weights.read(model.name)
        except BadOptionError as error:
            raise WrongWeightsError(model.name, "none", model.sha256) from error
    if found.card["sha256"] != model.sha256:
        raise WrongWeightsError(model.name, found.card["sha256"], model.sha256)
    return weights.build(found, model.name)
