# SPDX-License-Identifier: Apache-2.0
"""Models that requests may name: the released ones, and those of a folder that is watched.

Weights are used once their sha256 is that of their card and a network could be built of them; until
then the previous ones of that name stay. A share of the requests that name no model may go to
another one than the default, the canary.
"""

import asyncio
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import structlog

from pugeo_model import weights
from pugeo_model.errors import BadOptionError, CloudError
from pugeo_service.engine import Engine, ModelId
from pugeo_service.problems import ProblemError
from pugeo_service.settings import Settings

__all__ = ["CANARY_HEADER", "Models", "ServedModel", "wants_canary"]

CANARY_HEADER = "Pugeo-Canary"
_WISHES = {"yes": True, "no": False}
_LOOK_S = 2.0
# Names are sent in headers of answers, and are parts of paths.
_NAME = re.compile(r"[A-Za-z0-9._-]+")
_NAME_RULE = "the name of a model has ASCII letters, digits and . _ - only"
_BUILD = "import sys; from pugeo_model.weights import load_or_explain; load_or_explain(sys.argv[1])"

_now = time.monotonic
_log = structlog.stdlib.get_logger("pugeo.models")


@dataclass(frozen=True)
class ServedModel:
    """One model of the service.

    Attributes:
        name: name of the file of its weights.
        card: model card, with the ``sha256``.
        own: its weights, if they are not part of the package.
    """

    name: str
    card: dict[str, Any]
    own: weights.Weights | None

    @property
    def id(self) -> ModelId:
        """Its name and sha256, for workers."""
        return ModelId(self.name, self.card["sha256"])

    @property
    def described(self) -> dict[str, str]:
        """``name``, ``version`` and ``sha256``, for answers."""
        return {
            "name": self.name,
            "version": str(self.card["version"]),
            "sha256": self.card["sha256"],
        }


class Models:
    """All models of one service.

    Args:
        settings: name the default, the folder and the canary.

    Raises:
        BadOptionError: the default or the canary does not exist, cannot be used, or has a name
            that answers cannot carry; the message begins with the setting.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        given = Path(settings.model)
        self._file = given if given.suffix == ".safetensors" else None
        self._default = given.stem if self._file else settings.model
        self._canary = settings.canary
        self._served: dict[str, ServedModel] = {}
        self._stamps: dict[str, object] = {}
        self._unnamed: set[Path] = set()
        self._removed: list[tuple[float, str]] = []
        if self._file is not None and not _NAME.fullmatch(self._default):
            raise _wrong("PUGEO_MODEL", settings.model, _NAME_RULE)
        for name, path in self._paths().items():
            try:
                self._served[name] = self._read(name, path)
            except CloudError as error:
                if name == self._default:
                    raise _wrong("PUGEO_MODEL", settings.model, error.message) from None
                _log.error("weights are not used", model=name, reason=error.message)
        names = ", ".join(sorted(self._served))
        if self._default not in self._served:
            missing = f"no weights {self._default!r}: give one of {names} or the path of a file"
            raise _wrong("PUGEO_MODEL", settings.model, missing)
        if self._canary is not None and self._canary[0] not in self._served:
            raise _wrong(
                "PUGEO_CANARY", self._canary[0], f"no weights of this name: give one of {names}"
            )

    @property
    def default(self) -> ServedModel:
        """The model of requests that name none."""
        return self._served[self._default]

    @property
    def canary(self) -> tuple[str, float] | None:
        """Name and share of the canary, if there is one."""
        return self._canary

    def __iter__(self) -> Iterator[ServedModel]:
        """Iterate over all models, the default first."""
        yield self.default
        yield from (self._served[name] for name in sorted(self._served) if name != self._default)

    def named(self, name: str, status: int = 422) -> ServedModel:
        """Return a model by its name.

        Raises:
            ProblemError: of this status, there is no such model.
        """
        if name in self._served:
            return self._served[name]
        names = sorted(self._served)
        detail = f"There is no model {name[:80]!r}; this service has {', '.join(names)}."
        fields = {"parameter": "model", "value": name[:80], "allowed": names}
        raise ProblemError(status, "unknown_model", detail, retryable=False, fields=fields)

    def choose(self, name: str | None, wish: bool | None, chance: float) -> ServedModel:
        """Choose the model of a request.

        Args:
            name: model that the request names, or ``None``.
            wish: whether the request wants the canary; ``None`` leaves it to chance.
            chance: uniform in [0, 1).

        Raises:
            ProblemError: 422, there is no model of that name.
        """
        if name is not None:
            return self.named(name)
        if self._canary is not None:
            canary, share = self._canary
            # It may have been removed from the folder since.
            if canary in self._served and (chance < share if wish is None else wish):
                return self._served[canary]
        return self.default

    async def install(self, engine: Engine) -> None:
        """Give the workers all weights that are not part of the package."""
        for model in self._served.values():
            if model.own is not None:
                await engine.install(model.own)

    async def watch(self, engine: Engine) -> None:
        """Look for new, changed and removed weights until this is cancelled."""
        while True:
            await asyncio.sleep(_LOOK_S)
            try:
                await self._update(engine)
            except Exception:  # noqa: BLE001 - an unexpected error must not end the watch
                _log.exception("weights cannot be updated")

    async def _update(self, engine: Engine) -> None:
        present, changed = await asyncio.to_thread(self._look)
        for name in list(self._served.keys() - present - {self._default}):
            self._forget(self._served.pop(name))
            # The same file may come back.
            self._stamps.pop(name, None)
            _log.info("model removed", model=name)
        for model in changed:
            before = self._served.get(model.name)
            if before is not None and before.card == model.card:
                continue
            if model.own is not None:
                await engine.install(model.own)
            self._served[model.name] = model
            if before is not None:
                self._forget(before)
            _log.info("model loaded", **model.described)
        now = _now()
        needed = {model.card["sha256"] for model in self._served.values() if model.own is not None}
        for due in [each for each in self._removed if each[0] < now]:
            self._removed.remove(due)
            # Another model may have the same weights, or the file may have come back.
            if due[1] not in needed:
                await engine.remove(due[1])

    def _forget(self, model: ServedModel) -> None:
        """Take weights from the workers once no request that began with them can be running."""
        longest = max(self._settings.deadline_s, self._settings.jobs_deadline_s)
        if model.own is not None:
            self._removed.append((_now() + longest, model.card["sha256"]))

    def _paths(self) -> dict[str, Path]:
        """Return the files of weights by name; those of the folder come before released ones."""
        found = {name: weights.locate(name) for name in weights.available()}
        folder = self._settings.models_dir
        if folder is not None:
            found |= self._named_files(sorted(folder.glob("*.safetensors")))
        if self._file is not None:
            found[self._default] = self._file
        return found

    def _named_files(self, paths: list[Path]) -> dict[str, Path]:
        """Return files by the names of their models; the log gets a line for each unusable name."""
        unnamed = {path for path in paths if not _NAME.fullmatch(path.stem)}
        for path in sorted(unnamed - self._unnamed):
            _log.error("weights are not used", file=ascii(path.name), reason=_NAME_RULE)
        self._unnamed = unnamed
        return {path.stem: path for path in paths if path not in unnamed}

    def _look(self) -> tuple[set[str], list[ServedModel]]:
        """Return the names that have files, and the models whose files have changed."""
        paths, changed = self._paths(), []
        for name, path in paths.items():
            if self._stamps.get(name) != _stamp(path):
                try:
                    changed.append(self._read(name, path))
                except CloudError as error:
                    _log.error("changed weights are not used", model=name, reason=error.message)
        return set(paths), changed

    def _read(self, name: str, path: Path) -> ServedModel:
        """Read weights; own ones are also built once.

        Raises:
            BadOptionError: they cannot be used.
        """
        self._stamps[name] = _stamp(path)
        read = weights.read(path)
        if "version" not in read.card:
            raise BadOptionError(f"the card of the weights {str(path)!r} has no version")
        released = name in weights.available() and path == weights.locate(name)
        if not released:
            _build(path)
        return ServedModel(name, {**read.card, "name": name}, None if released else read)


def wants_canary(headers: Mapping[str, str]) -> bool | None:
    """Return the wish of a request's header ``Pugeo-Canary: yes`` or ``no``, if there is one."""
    return _WISHES.get(headers.get(CANARY_HEADER.lower(), "").strip().lower())


def _wrong(setting: str, value: str, reason: str) -> BadOptionError:
    return BadOptionError(f"{setting}={value}: {reason}", code="unknown_model", value=value)


def _build(path: Path) -> None:
    """Build a network in a process that ends again, because this one must stay free of torch.

    Raises:
        BadOptionError: the file is not what its card says.
    """
    command = [sys.executable, "-c", _BUILD, str(path)]
    built = subprocess.run(command, check=False, capture_output=True, text=True)  # noqa: S603
    if built.returncode:
        last = (built.stderr.strip().splitlines() or ["the process ended"])[-1]
        raise BadOptionError(last, value=str(path))


def _stamp(path: Path) -> object:
    """Return a value that changes with the file, its weights or their card."""
    found: list[object] = [path]
    for each in (path, path.with_suffix(".json")):
        try:
            status = each.stat()
        except OSError as error:
            found.append(error.errno)
        else:
            found.append((status.st_mtime_ns, status.st_size, status.st_ino))
    return found
