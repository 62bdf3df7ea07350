# SPDX-License-Identifier: Apache-2.0
"""Weights: a safetensors file beside a JSON model card. Reading a card imports no torch."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pugeo_model.errors import BadOptionError

if TYPE_CHECKING:
    from pugeo_model.network.model import Model
    from pugeo_model.network.patch_model import PatchModel

__all__ = [
    "Weights", "available", "build", "load", "load_or_explain", "locate", "read", "read_card",
    "save", "start_from",
]  # fmt: skip

_RELEASED = Path(__file__).parent / "released"


def available() -> list[str]:
    """Return the names of the released weights, which are part of the package."""
    return sorted(path.stem for path in _RELEASED.glob("*.safetensors"))


def locate(name_or_path: str | Path) -> Path:
    """Return the path of the ``.safetensors`` file of released or own weights.

    Raises:
        BadOptionError: no such weights.
    """
    path = Path(name_or_path)
    if path.suffix != ".safetensors":
        path = _RELEASED / f"{name_or_path}.safetensors"
    if not path.is_file():
        raise BadOptionError(
            f"no weights {str(name_or_path)!r}: give one of {', '.join(available()) or 'none'}"
            " or the path of a .safetensors file with its card beside it",
            code="unknown_model",
            value=str(name_or_path),
            allowed=available(),
        )
    return path


@dataclass(frozen=True)
class Weights:
    """The bytes of a ``.safetensors`` file and its model card, which belong together.

    Attributes:
        card: the card, with the ``sha256`` of the bytes.
        data: the bytes.
    """

    card: dict[str, Any]
    data: bytes


def read(name_or_path: str | Path) -> Weights:
    """Read released or own weights, and compare them with their card.

    Raises:
        BadOptionError: no such weights or card, or they do not belong together: a card that states
            another ``sha256`` means that the file is damaged, or the card that of other weights.
    """
    path = locate(name_or_path)
    card_path = path.with_suffix(".json")
    try:
        found_card: Any = json.loads(card_path.read_text("utf-8"))
        data = path.read_bytes()
    except FileNotFoundError:
        raise _unusable(
            name_or_path, f"their card {card_path.name} is missing beside them"
        ) from None
    except OSError as error:
        raise _unusable(name_or_path, f"cannot be read: {error.strerror}") from None
    except ValueError:
        raise _unusable(name_or_path, f"their card {card_path.name} is no JSON") from None
    if not isinstance(found_card, dict) or "architecture" not in found_card:
        raise _unusable(name_or_path, f"their card {card_path.name} names no architecture")
    card: dict[str, Any] = found_card
    found = hashlib.sha256(data).hexdigest()
    if card.setdefault("sha256", found) != found:
        raise _unusable(
            name_or_path,
            f"their sha256 is {found[:12]}..., their card says {str(card['sha256'])[:12]}...: the "
            "file is damaged or belongs to another card",
        )
    return Weights(card, data)


def read_card(name_or_path: str | Path = "standard") -> dict[str, Any]:
    """Read the model card of released or own weights; see `read`."""
    return read(name_or_path).card


def load(name_or_path: str | Path = "standard") -> "Model | PatchModel":
    """Build the network that a card describes and load its weights; see `read` and `build`."""
    return build(read(name_or_path), name_or_path)


def build(weights: Weights, name: str | Path) -> "Model | PatchModel":
    """Build the network that a card describes, with its weights.

    Args:
        weights: the card and the bytes.
        name: of the weights, for errors.

    Returns:
        A ``Model``, which predicts charts, or a ``PatchModel``, which upsamples whole patches.

    Raises:
        BadOptionError: damaged weights, or those of another network than their card says.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load as load_tensors

    from pugeo_model.network.build import build_network
    from pugeo_model.network.model import Model
    from pugeo_model.network.patch_model import PatchModel
    from pugeo_model.network.pugeo import Architecture, PUGeoNet

    card = weights.card
    try:
        net = build_network(Architecture.from_json(card["architecture"]))
        net.load_state_dict(load_tensors(weights.data))
    except SafetensorError as error:
        raise _unusable(name, f"the file is damaged: {error}") from None
    except (RuntimeError, TypeError, KeyError, ValueError) as error:
        # torch names each tensor that differs; the first line and the first tensor say enough.
        reason = " ".join(str(error).split())[:200]
        raise _unusable(name, f"not of the network of their card: {reason}") from None
    return Model(net, card) if isinstance(net, PUGeoNet) else PatchModel(net, card)


def load_or_explain(name_or_path: str | Path) -> None:
    """Load weights to see that they can be; end the process with one line if they cannot."""
    try:
        load(name_or_path)
    except BadOptionError as error:
        raise SystemExit(error.message) from None


def start_from(net: Any, name_or_path: str | Path) -> None:
    """Load weights into a network of the same architecture, to continue training from them.

    Raises:
        BadOptionError: no such weights, or they have another architecture.
    """
    from safetensors.torch import load_file

    given = read_card(name_or_path)["architecture"]
    expected = net.architecture.to_json()
    if given != expected:
        raise BadOptionError(
            f"{str(name_or_path)!r} has the architecture {given}, the recipe {expected}:"
            " change the recipe, or start from other weights",
            value=str(name_or_path),
        )
    try:
        net.load_state_dict(load_file(locate(name_or_path)))
    except RuntimeError as error:
        # The inputs of a layer may differ between versions of one architecture.
        raise BadOptionError(
            f"{str(name_or_path)!r} belongs to another version of this network: {error}",
            value=str(name_or_path),
        ) from None


def save(net: Any, card: dict[str, Any], path: Path) -> None:
    """Write weights (float32) and their card side by side.

    Args:
        net: the network.
        card: JSON-able; the architecture is added.
        path: ends in ``.safetensors``.
    """
    from safetensors.torch import save_file

    path.parent.mkdir(parents=True, exist_ok=True)
    save_file({name: value.contiguous() for name, value in net.state_dict().items()}, path)
    # The library writes files that only the owner can read; a package is for all users.
    path.chmod(0o644)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    card = {**card, "architecture": net.architecture.to_json(), "sha256": digest}
    path.with_suffix(".json").write_text(json.dumps(card, indent=2) + "\n", "utf-8")


def _unusable(name_or_path: str | Path, reason: str) -> BadOptionError:
    name = str(name_or_path)
    return BadOptionError(f"the weights {name!r} cannot be used: {reason}", value=name)
