# SPDX-License-Identifier: Apache-2.0
"""Released weights: safetensors beside a JSON model card. Reading a card imports no torch."""

import hashlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pugeo_model.errors import BadOption

if TYPE_CHECKING:
    from pugeo_model.network.model import Model

__all__ = ["available", "load", "locate", "read_card", "save", "start_from"]

_RELEASED = Path(__file__).parent / "released"
_NOISY = "-noisy"  # behind the name of weights: those beside them, for inputs with noise


def available() -> list[str]:
    """Names of the weights inside the package."""
    return sorted(p.stem for p in _RELEASED.glob("*.safetensors") if not p.stem.endswith(_NOISY))


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

    Where ``NAME-noisy.safetensors`` lies beside them, ``noisy`` is the card of these, and the
    checksum that of both files, one after the other.

    Raises:
        BadOption: no such weights.
    """
    path = locate(name_or_path)
    digest = hashlib.sha256(path.read_bytes())
    card = _card(path)
    noisy = _noisy(path)
    if noisy is not None:
        digest.update(noisy.read_bytes())
        card["noisy"] = _card(noisy)
    card["sha256"] = digest.hexdigest()
    return card


def _noisy(path: Path) -> Path | None:
    """The weights beside others that take inputs with noise, if there are any."""
    beside = path.with_stem(path.stem + _NOISY)
    return beside if beside.is_file() else None


def _card(path: Path) -> dict[str, Any]:
    card: dict[str, Any] = json.loads(path.with_suffix(".json").read_text("utf-8"))
    return card


def load(name_or_path: str | Path = "standard") -> "Model":
    """Rebuild the networks of a card and fill in their weights.

    Raises:
        BadOption: no such weights.
    """
    from pugeo_model.network.model import Model

    path = locate(name_or_path)
    noisy = _noisy(path)
    return Model(_rebuilt(path), read_card(path), None if noisy is None else _rebuilt(noisy))


def _rebuilt(path: Path) -> Any:
    from safetensors.torch import load_file

    from pugeo_model.network.pugeo import Architecture, PUGeoNet

    net = PUGeoNet(Architecture.from_json(_card(path)["architecture"]))
    net.load_state_dict(load_file(path))
    return net


def start_from(net: Any, name_or_path: str | Path) -> None:
    """Fill a network in with weights of its own architecture, to train on from them.

    Raises:
        BadOption: no such weights, or they are of another architecture.
    """
    from safetensors.torch import load_file

    path = locate(name_or_path)
    made = _card(path)["architecture"]
    wanted = net.architecture.to_json()
    if made != wanted:
        raise BadOption(
            f"{str(name_or_path)!r} has the architecture {made}, the recipe {wanted}",
            value=str(name_or_path),
        )
    net.load_state_dict(load_file(path))


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
