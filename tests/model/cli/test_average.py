# SPDX-License-Identifier: Apache-2.0
"""``pugeo average``."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from pugeo_model import weights

Run = Callable[..., Any]


@pytest.fixture
def tuned(tmp_path: Path) -> Path:
    """The weights of `fast`, changed a little, as by a training."""
    folder = tmp_path / "tuned"
    folder.mkdir()
    path = folder / "tuned.safetensors"
    generator = torch.Generator().manual_seed(0)
    tensors = load_file(weights.locate("fast"))
    save_file(
        {
            name: value + 0.01 * torch.randn(value.shape, generator=generator)
            for name, value in tensors.items()
        },
        path,
    )
    card = {**weights.read_card("fast"), "name": "tuned", "training": {"steps": 7}}
    card["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    path.with_suffix(".json").write_text(json.dumps(card), "utf-8")
    return path


def test_between_two(pugeo: Run, tuned: Path, tmp_path: Path) -> None:
    """Each tensor lies between those of both; the card names them, and the weights load."""
    out = tmp_path / "new" / "mine.safetensors"
    done = pugeo("average", "fast", tuned, "--share", "0.25", "-o", out)
    assert done.status == 0, done.stderr
    found, first, second = (load_file(weights.locate(each)) for each in (out, "fast", tuned))
    assert found.keys() == first.keys()
    for name, tensor in found.items():
        torch.testing.assert_close(tensor, 0.75 * first[name] + 0.25 * second[name])
    card = json.loads(out.with_suffix(".json").read_text("utf-8"))
    assert card["name"] == "mine"
    cards = [weights.read_card(name) for name in ("fast", tuned)]
    assert card["training"] == {
        **cards[0]["training"],
        "average": {
            "sha256": cards[0]["sha256"],
            "with": "tuned",
            "with_sha256": cards[1]["sha256"],
            "share": 0.25,
            "training": cards[1]["training"],
        },
    }
    assert weights.load(out).card["sha256"] == card["sha256"]


def test_the_ends(pugeo: Run, tuned: Path, tmp_path: Path) -> None:
    """A share of 0 gives the first weights, one of 1 the second, to the bit."""
    for share, name in ((0, "fast"), (1, tuned)):
        out = tmp_path / f"{share}.safetensors"
        pugeo("average", "fast", tuned, "--share", share, "-o", out)
        assert out.read_bytes() == weights.locate(name).read_bytes()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("fast", "fast", "--share", "1.5"), "share must be a number from 0 to 1"),
        (("fast", "fast", "--share", "nan"), "share must be a number from 0 to 1"),
        (("standard", "fast"), "only weights of one network"),
        (("fast", "none"), "no weights 'none'"),
    ],
)
def test_refused(pugeo: Run, tmp_path: Path, arguments: tuple[str, ...], words: str) -> None:
    """A line names the fault; nothing is written."""
    done = pugeo("average", *arguments, "-o", tmp_path / "x.safetensors")
    assert done.status == 2
    assert words in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_name_that_is_not_found_again(pugeo: Run, tmp_path: Path) -> None:
    """Weights are found by their suffix, so another one is refused."""
    done = pugeo("average", "fast", "fast", "-o", tmp_path / "x.pt")
    assert done.status == 2
    assert "does not end in .safetensors" in done.stderr
