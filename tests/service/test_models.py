# SPDX-License-Identifier: Apache-2.0
"""Models by name: released and own ones, changed while the service runs, chosen by chance."""

import asyncio
import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from pugeo_model import weights
from pugeo_model.errors import BadOptionError
from pugeo_service import models
from pugeo_service.engine import Engine
from pugeo_service.models import Models, wants_canary
from pugeo_service.problems import ProblemError
from pugeo_service.settings import Settings


def copy(released: str, folder: Path, name: str) -> Path:
    """Copy released weights with their card under another name."""
    for suffix in (".safetensors", ".json"):
        shutil.copy(weights.locate(released).with_suffix(suffix), folder / f"{name}{suffix}")
    return folder / f"{name}.safetensors"


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A copy of released weights with their card."""
    return copy("fast", tmp_path, "own")


@pytest.fixture
def unbuilt(monkeypatch: pytest.MonkeyPatch) -> None:
    """Own weights are not built, which takes seconds; tests of that do without this."""
    monkeypatch.setattr(models, "_build", lambda _: None)


def change_card(path: Path, change: dict[str, Any]) -> None:
    """Replace members of a card; ``None`` removes one."""
    card = json.loads(path.with_suffix(".json").read_text()) | change
    kept = {name: value for name, value in card.items() if value is not None}
    path.with_suffix(".json").write_text(json.dumps(kept))


def alter(path: Path) -> str:
    """Change one bit of weights, and their card with it; return the new sha256."""
    data = bytearray(path.read_bytes())
    data[-2] ^= 1
    path.write_bytes(data)
    digest = hashlib.sha256(data).hexdigest()
    change_card(path, {"sha256": digest})
    return digest


def told(model: object) -> str:
    """The line about a default model that cannot be used."""
    with pytest.raises(BadOptionError) as caught:
        Models(Settings(model=str(model)))
    line = caught.value.message
    assert line.startswith(f"PUGEO_MODEL={model}: ")
    assert "\n" not in line
    return line


def told_of(path: Path) -> str:
    """The error about a file of weights, which may have any name."""
    with pytest.raises(BadOptionError) as caught:
        Models(Settings(model=str(path)))
    return caught.value.message


class Workers(Engine):
    """An engine without workers that records the weights it is given."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, str]] = []

    async def install(self, weights: weights.Weights) -> None:
        """Record the weights."""
        self.calls.append(("install", weights.card["sha256"]))

    async def remove(self, sha256: str) -> None:
        """Record the sha256."""
        self.calls.append(("remove", sha256))


def update(served: Models, workers: Workers) -> None:
    """Look at the folder once."""
    asyncio.run(served._update(workers))


def test_released_models_are_served() -> None:
    """All released models have names, the default comes first, their cards state their sha256."""
    served = Models(Settings(model="fast"))
    assert [model.name for model in served] == ["fast", "standard"]
    assert served.default.name == "fast"
    for model in served:
        card = json.loads(weights.locate(model.name).with_suffix(".json").read_text())
        assert model.described["sha256"] == card["sha256"] == model.id.sha256
        assert model.own is None


def test_no_such_weights() -> None:
    """An unknown default is refused with the known names, and so is an unknown canary."""
    assert "give one of fast, standard" in told("huge")
    with pytest.raises(BadOptionError, match="PUGEO_CANARY=huge: no weights of this name"):
        Models(Settings(canary=("huge", 0.5)))


def test_damaged_weights_are_not_served(own: Path) -> None:
    """Weights with other bytes than their card states are refused."""
    data = bytearray(own.read_bytes())
    data[-100_000:] = b"\xff" * 100_000
    own.write_bytes(data)
    assert "damaged or belongs to another card" in told(own)


@pytest.mark.parametrize("content", [None, "", "[]", "{}"])
def test_weights_without_a_card(own: Path, content: str | None) -> None:
    """A card that is missing, empty, no object or incomplete is named."""
    card = own.with_suffix(".json")
    card.unlink() if content is None else card.write_text(content)
    assert "card own.json" in told(own)


def test_a_card_has_a_version(own: Path) -> None:
    """Answers name the version of the weights, so the card must."""
    change_card(own, {"version": None})
    assert "has no version" in told(own)


@pytest.mark.slow
def test_weights_that_do_not_load(own: Path) -> None:
    """Without a sha256 in the card, weights that are cut or of another network are refused too."""
    change_card(own, {"sha256": None})
    assert Models(Settings(model=str(own))).default.name == "own"
    other = json.loads(weights.locate("standard").with_suffix(".json").read_text())
    change_card(own, {"architecture": other["architecture"]})
    assert "not of the network of their card" in told(own)
    own.write_bytes(own.read_bytes()[:-1000])
    assert "the file is damaged" in told(own)


@pytest.mark.usefixtures("unbuilt")
def test_a_folder_of_models(tmp_path: Path) -> None:
    """Models of the folder have the names of their files; a broken one does not stop the others."""
    copy("fast", tmp_path, "mine")
    copy("fast", tmp_path, "broken").write_bytes(b"")
    served = Models(Settings(models_dir=tmp_path))
    assert [model.name for model in served] == ["standard", "fast", "mine"]
    mine = served.named("mine")
    assert mine.card["name"] == "mine"
    assert mine.own is not None
    workers = Workers()
    asyncio.run(served.install(workers))
    assert workers.calls == [("install", mine.id.sha256)]


@pytest.mark.usefixtures("unbuilt")
@pytest.mark.parametrize("name", ["日本", "two words", "a\nb", "é", "a;b"])
def test_names_that_headers_cannot_carry(tmp_path: Path, name: str) -> None:
    """Weights of such a name are not served; the log says so once, until the file comes back."""
    path = copy("fast", tmp_path, name)
    copy("fast", tmp_path, "v1.2_a-B")
    with capture_logs() as logs:
        served, workers = Models(Settings(models_dir=tmp_path)), Workers()
        update(served, workers)
        update(served, workers)
    assert [model.name for model in served] == ["standard", "fast", "v1.2_a-B"]
    refused = [entry for entry in logs if entry["event"] == "weights are not used"]
    assert [entry["file"] for entry in refused] == [ascii(path.name)]
    assert "ASCII letters, digits and . _ -" in refused[0]["reason"]
    path.rename(tmp_path / "away")
    update(served, workers)
    (tmp_path / "away").rename(path)
    with capture_logs() as logs:
        update(served, workers)
    assert len(logs) == 1
    assert "ASCII letters, digits and . _ -" in told_of(path)


@pytest.mark.usefixtures("unbuilt")
def test_weights_are_replaced_while_the_service_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """New weights go to the workers before requests get them; the old ones leave later."""
    copy("fast", tmp_path, "standard")
    served, workers = Models(Settings(models_dir=tmp_path)), Workers()
    before = served.default
    assert before.id.sha256 == weights.read_card("fast")["sha256"]
    update(served, workers)
    assert workers.calls == []

    sha256 = alter(tmp_path / "standard.safetensors")
    update(served, workers)
    after = served.default
    assert after.id.sha256 == sha256
    assert workers.calls == [("install", after.id.sha256)]
    # Requests that began with the old weights may take as long as a job may.
    monkeypatch.setattr(models, "_now", lambda: 1e9)
    update(served, workers)
    assert workers.calls[1:] == [("remove", before.id.sha256)]


@pytest.mark.usefixtures("unbuilt")
def test_half_a_replacement_changes_nothing(tmp_path: Path) -> None:
    """Weights whose card is not there yet are not used; with the card they are."""
    path = copy("fast", tmp_path, "mine")
    served, workers = Models(Settings(models_dir=tmp_path)), Workers()
    before = path.with_suffix(".json").read_bytes()
    sha256 = alter(path)
    card = path.with_suffix(".json").read_bytes()
    path.with_suffix(".json").write_bytes(before)
    update(served, workers)
    assert served.named("mine").id.sha256 == weights.read_card("fast")["sha256"]
    assert workers.calls == []
    path.with_suffix(".json").write_bytes(card)
    update(served, workers)
    assert served.named("mine").id.sha256 == sha256


@pytest.mark.usefixtures("unbuilt")
def test_models_come_and_go(tmp_path: Path) -> None:
    """A new file is a new model; without its file it is unknown, and the default stays."""
    served, workers = Models(Settings(models_dir=tmp_path)), Workers()
    path = copy("fast", tmp_path, "mine")
    copy("fast", tmp_path, "standard")
    update(served, workers)
    assert {"mine", "standard"} <= {model.name for model in served}
    path.unlink()
    update(served, workers)
    with pytest.raises(ProblemError, match="no model 'mine'; this service has fast") as caught:
        served.named("mine")
    assert caught.value.fields["allowed"] == ["fast", "standard"]
    # Without its file in the folder the default is the released one again.
    (tmp_path / "standard.safetensors").unlink()
    update(served, workers)
    assert served.default.own is None


@pytest.mark.usefixtures("unbuilt")
def test_weights_that_another_model_has_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A canary that became the default and was removed takes no weights from the default."""
    canary = copy("fast", tmp_path, "next")
    served, workers = Models(Settings(models_dir=tmp_path)), Workers()
    copy("fast", tmp_path, "standard")
    update(served, workers)
    canary.unlink()
    update(served, workers)
    monkeypatch.setattr(models, "_now", lambda: 1e9)
    update(served, workers)
    assert [call for call, _ in workers.calls] == ["install"]
    (tmp_path / "standard.safetensors").unlink()
    update(served, workers)
    monkeypatch.setattr(models, "_now", lambda: 2e9)
    update(served, workers)
    assert workers.calls[1:] == [("remove", weights.read_card("fast")["sha256"])]


@pytest.mark.usefixtures("unbuilt")
def test_a_file_that_comes_back(tmp_path: Path) -> None:
    """A file that was moved away and back, unchanged, is a model again."""
    path = copy("fast", tmp_path, "mine")
    served, workers = Models(Settings(models_dir=tmp_path)), Workers()
    path.rename(tmp_path / "away")
    update(served, workers)
    with pytest.raises(ProblemError):
        served.named("mine")
    (tmp_path / "away").rename(path)
    update(served, workers)
    assert served.named("mine").own is not None


def test_a_share_of_the_requests_gets_the_canary() -> None:
    """Chance decides below the share, the header before chance, a name before both."""
    served = Models(Settings(canary=("fast", 0.25)))
    assert served.canary == ("fast", 0.25)
    assert served.choose(None, None, 0.2499).name == "fast"
    assert served.choose(None, None, 0.25).name == "standard"
    assert served.choose(None, True, 0.9).name == "fast"
    assert served.choose(None, False, 0.1).name == "standard"
    assert served.choose("standard", True, 0.1).name == "standard"
    without = Models(Settings())
    assert without.choose(None, True, 0.0).name == "standard"


@pytest.mark.parametrize(
    ("value", "wish"), [("yes", True), (" No ", False), ("maybe", None), (None, None)]
)
def test_the_header_of_the_canary(value: str | None, wish: bool | None) -> None:
    """Other values than yes and no leave it to chance."""
    assert wants_canary({} if value is None else {"pugeo-canary": value}) is wish
