# SPDX-License-Identifier: Apache-2.0
"""Averages of the weights of two networks, one of which was trained on from the other.

Training on new inputs makes a network better there and a little worse on the old ones. Between the
weights before and after there are networks that keep most of both (Wortsman et al., "Robust
fine-tuning of zero-shot models", CVPR 2022).
"""

from pathlib import Path
from typing import Any

import torch

from pugeo_model.errors import BadOptionError
from pugeo_model.network.build import build_network
from pugeo_model.network.pugeo import Architecture
from pugeo_model.options import refuse
from pugeo_model.weights import read_card, save, start_from

__all__ = ["average"]


def average(first: str | Path, second: str | Path, share: float, path: Path) -> dict[str, Any]:
    """Write ``(1 - share) * first + share * second``, tensor by tensor, with its model card.

    Args:
        first: released weights by name, or the path of a ``.safetensors`` file.
        second: the other weights, likewise. The card of the average repeats the training of both.
        share: of the second, from 0 to 1.
        path: the file to write; ends in ``.safetensors``.

    Returns:
        The card, without the measured quality of either.

    Raises:
        BadOptionError: a share beyond 0 to 1, no such weights, weights of different networks, or
            a path that does not end in ``.safetensors``.
    """
    if not 0 <= share <= 1:
        refuse("share", share, "a number from 0 to 1", limit=[0, 1])
    if path.suffix != ".safetensors":
        raise BadOptionError(
            f"{str(path)!r} does not end in .safetensors, by which weights are found",
            value=str(path),
        )
    cards = [read_card(first), read_card(second)]
    if cards[0]["architecture"] != cards[1]["architecture"]:
        raise BadOptionError(
            f"{str(first)!r} has the architecture {cards[0]['architecture']}, {str(second)!r} has "
            f"{cards[1]['architecture']}: only weights of one network can be averaged",
            value=str(second),
        )
    net, other = (build_network(Architecture.from_json(card["architecture"])) for card in cards)
    start_from(net, first)
    start_from(other, second)
    tensors = other.state_dict()
    net.load_state_dict(
        {name: torch.lerp(value, tensors[name], share) for name, value in net.state_dict().items()}
    )
    card = {
        **cards[0],
        "name": path.stem,
        "training": {
            **cards[0]["training"],
            "average": {
                "sha256": cards[0]["sha256"],
                "with": cards[1]["name"],
                "with_sha256": cards[1]["sha256"],
                "share": share,
                "training": cards[1]["training"],
            },
        },
        "quality": {},
    }
    save(net, card, path)
    return card
