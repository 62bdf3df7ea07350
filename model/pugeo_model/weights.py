# SPDX-License-Identifier: Apache-2.0
"""Released weights: safetensors beside a JSON model card. Reading a card imports no torch."""

import hashlib
import json
from pathlib import Path
from typing import Any

from pugeo_model.errors import BadOption

__all__ = ["available", "load", "locate", "read_card", "save", "start_from"]

_RELEASED = Path(__file__).parent / "released"


def available() -> list[str]:
    """Names of the weights inside the package."""
    return sorted(path.stem for path in _RELEASED.glob("*.safetensors"))


def locate(name_or_path: str | Path) -> Path:
    """Path of the ``.safetensors`` file of released or own weights.

    Raises:
        BadOption: no such weights.
    """
    path = Path(name_or_path)
    if path.suffix != ".safetensors":
        path = _RELEASED / f"{name_or_path}.safetensors"
    if not path.is_file():
        raise BadOption(
            f"no weights {str(name_or_path)!r}: give one of {', '.join(available()) or 'none'}"
            " or the path of a .safetensors file with its card beside it",
            code="unknown_model",
            value=str(name_or_path),
            allowed=available(),
        )
    return path


def read_card(name_or_path: str | Path = "standard") -> dict[str, Any]:
    """The model card of released or own weights, with the weights' ``sha256``.

    Raises:
        BadOption: no such weights.
    """
    path = locate(name_or_path)
    card: dict[str, Any] = json.loads(path.with_suffix(".json").read_text("utf-8"))
    card["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    return card


def load(name_or_path: str | Path = "standard") -> Any:
    """Rebuild the network of a card and fill in its weights.

    Returns:
        A ``Model`` that predicts charts, or a ``PatchModel`` that upsamples whole patches.

    Raises:
        BadOption: no such weights.
    """
    from safetensors.torch import load_file

    from pugeo_model.network.build import build_network
    from pugeo_model.network.model import Model
    from pugeo_model.network.patch_model import PatchModel
    from pugeo_model.network.pugeo import Architecture, PUGeoNet

    card = read_card(name_or_path)
    net = build_network(Architecture.from_json(card["architecture"]))
    net.load_state_dict(load_file(locate(name_or_path)))
    return Model(net, card) if isinstance(net, PUGeoNet) else PatchModel(net, card)


def start_from(net: Any, name_or_path: str | Path) -> None:
    """Fill a network in with weights of its own architecture, to train on from them.

    Raises:
        BadOption: no such weights, or they are of another architecture.
    """
    from safetensors.torch import load_file

    made = read_card(name_or_path)["architecture"]
    wanted = net.architecture.to_json()
    if made != wanted:
        raise BadOption(
            f"{str(name_or_path)!r} has the architecture {made}, the recipe {wanted}",
            value=str(name_or_path),
        )
    try:
        net.load_state_dict(load_file(locate(name_or_path)))
    except RuntimeError as error:
        # What a message or a point tells the network is no matter of its architecture.
        raise BadOption(
            f"{str(name_or_path)!r} is of another version of this network: {error}",
            value=str(name_or_path),
        ) from None


def save(net: Any, card: dict[str, Any], path: Path) -> None:
    """Write weights (float32) and card side by side.

    Args:
        net: the network.
        card: JSON-able; its architecture is filled in here.
        path: ends in ``.safetensors``.
    """
    from safetensors.torch import save_file

    path.parent.mkdir(parents=True, exist_ok=True)
    save_file({name: value.contiguous() for name, value in net.state_dict().items()}, path)
    # The library writes for the owner alone; weights inside a package are for everyone.
    path.chmod(0o644)
    card = {**card, "architecture": net.architecture.to_json()}
    path.with_suffix(".json").write_text(json.dumps(card, indent=2) + "\n", "utf-8")
