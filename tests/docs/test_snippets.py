# SPDX-License-Identifier: Apache-2.0
"""Every snippet of the documentation runs, and gives the output that the page shows.

A line that is `pugeo` with plain words runs in this process, which has loaded the network; all
others run in bash. In README.md all run in bash, as at a reader's terminal.
"""

import contextlib
import importlib.util
import io
import itertools
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from tests.docs.samples import FILES
from tests.docs.snippets import RUN, SHOWN, Snippet, pages, snippets

from pugeo_model.cli import main

Serve = Callable[..., str]
ROOT = Path(__file__).resolve().parents[2]
RUNNABLE = [page for page in pages(ROOT) if any(s.language in RUN for s in snippets(page, ROOT))]
# Installs and containers are too much for a test: what they name is looked up instead.
LOOKED_UP = re.compile(r"(make|docker|helm|kubectl|pip install|\. \.venv/bin/activate)\b")
# Lines of progress, which a busy machine has more of.
PROGRESS = re.compile(r"^[\w ]+: \d+%(, about \d+ \w+ left)?\n", re.MULTILINE)
# `pugeo` with words that mean the same to bash and to `shlex.split`.
PLAIN = re.compile(r"pugeo(?: +(?:[\w./,:=-]+|'[^']*'))+")
# curl is silent about an error's status unless told otherwise.
PRELUDE = 'set -euo pipefail; curl() { command curl --fail-with-body "$@"; }\n'


class Page:
    """What the snippets of a page share: a folder, Python names, the environment, a service.

    Args:
        folder: empty; the snippets run in it.
        address: of the service.
        serve: starts another one.
        in_bash: run `pugeo` in bash in any case.
    """

    def __init__(self, folder: Path, address: str, serve: Serve, *, in_bash: bool) -> None:
        self.in_bash = in_bash
        self.folder = folder
        self.serve = serve
        self.address = address
        self.names: dict[str, Any] = {"__name__": "__main__"}
        self.environment = {
            **os.environ,
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "PUGEO_URL": address,
            "QT_QPA_PLATFORM": "offscreen",
            "COLUMNS": "200",
        }

    def run(self, snippet: Snippet) -> None:
        """Run a snippet, and compare what it prints with the page."""
        code = re.sub(r"(http://)?(localhost|127\.0\.0\.1):8000", self.address, snippet.code)
        if snippet.language == "python":
            printed = self._python(code, snippet)
        else:
            printed = self._shell(code, snippet)
        if snippet.output is not None:
            compare(printed, snippet.output)

    def _python(self, code: str, snippet: Snippet) -> str:
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            exec(compile(code, snippet.place, "exec"), self.names)  # noqa: S102 - the very purpose
        return printed.getvalue()

    def _shell(self, code: str, snippet: Snippet) -> str:
        commands = [line for line in logical_lines(code) if line]
        if all(LOOKED_UP.match(line) for line in commands):
            for line in commands:
                look_up(line)
            return ""
        if commands[0].startswith("pugeo serve"):
            assert len(commands) == 1, f"{snippet.place}: pugeo serve stands alone"
            options = shlex.split(commands[0])[2:]
            if options:
                self.address = self.serve(*options, folder=self.folder)
                self.environment["PUGEO_URL"] = self.address
            return ""
        plain = [] if self.in_bash else list(itertools.takewhile(PLAIN.fullmatch, commands))
        printed = "".join(self._here(command, snippet) for command in plain)
        if len(plain) == len(commands):
            return printed
        done = subprocess.run(
            ["bash", "-c", PRELUDE + ("\n".join(commands[len(plain) :]) if plain else code)],
            cwd=self.folder, env=self.environment, text=True, check=False,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        assert (done.returncode != 0) == snippet.fails, f"{snippet.place}:\n{done.stdout}"
        key = re.search(r"The key, which is shown only once: (\S+)", done.stdout)
        if key:
            self.environment["PUGEO_API_KEY"] = key[1]
        return printed + PROGRESS.sub("", done.stdout)

    def _here(self, command: str, snippet: Snippet) -> str:
        """Run the command line in this process; returns what it prints on stdout and stderr."""
        printed = io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", shlex.split(command))
            patch.setattr(sys, "stdout", printed)
            patch.setattr(sys, "stderr", printed)
            for name, value in self.environment.items():
                patch.setenv(name, value)
            with pytest.raises(SystemExit) as ended:
                main()
        printed.seek(0)
        text = printed.read()
        assert bool(ended.value.code) == snippet.fails, f"{snippet.place}:\n{text}"
        return PROGRESS.sub("", text)


def logical_lines(code: str) -> list[str]:
    """Commands without comments; those that go on in the next line are joined."""
    lines = re.sub(r"\\\n\s*", "", code).splitlines()
    return [re.sub(r"(^|\s+)# .*", "", line).strip() for line in lines]


def look_up(command: str) -> None:
    """Check that targets, extras, profiles and files that a command names are there."""
    words = shlex.split(command)
    if words[0] == "make":
        makefile = (ROOT / "Makefile").read_text("utf-8")
        assert re.search(rf"^{re.escape(words[1])}:", makefile, re.MULTILINE), command
    elif words[:2] == ["pip", "install"]:
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
        named = re.fullmatch(r"\.(?:\[(\w+)\])?", words[2])
        if named and named[1]:
            assert named[1] in extras["optional-dependencies"], command
        elif not named:
            tools = extras["optional-dependencies"].values()
            assert any(words[2] in need for needs in tools for need in needs), command
    elif words[:2] == ["docker", "compose"]:
        compose = yaml.safe_load((ROOT / "docker-compose.yml").read_text("utf-8"))["services"]
        profiles = {name for each in compose.values() for name in each.get("profiles", ())}
        if "--profile" in words:
            assert words[words.index("--profile") + 1] in profiles, command
        asked = words[words.index("up") + 1 :] if "up" in words else []
        assert {word for word in asked if not word.startswith("-")} <= set(compose), command
        for path in re.findall(r"\./(deploy/[\w/.]+)", command):
            assert (ROOT / path).exists(), command
    elif words[:2] in (["helm", "install"], ["helm", "upgrade"]):
        look_up_values(ROOT / words[3] / "values.yaml", re.findall(r"--set ([\w.]+)=", command))
    elif words[0] == "docker":
        assert words[1] in {"build", "run", "tag"}, command
        for variable in re.findall(r"PUGEO_\w+", command):
            settings = (ROOT / "docs/reference/settings.md").read_text("utf-8")
            assert f"`{variable}`" in settings, command


def look_up_values(path: Path, names: list[str]) -> None:
    """Check that a chart has values of these names."""
    for name in names:
        value = yaml.safe_load(path.read_text("utf-8"))
        for part in name.split("."):
            value = value[part]


def compare(printed: str, shown: Snippet) -> None:
    """Compare output with what a page shows; three dots there stand for anything."""
    if shown.language == "json":
        matches(json.loads(printed), json.loads(shown.code), shown.place)
        return
    pattern = re.escape(shown.code.strip()).replace(r"\.\.\.", ".*")
    assert re.fullmatch(pattern, re.sub(r"[ \t\r]+\n", "\n", printed).strip()), (
        f"{shown.place} shows\n{shown.code}\nand what came is\n{printed}"
    )


def matches(found: Any, shown: Any, place: str) -> None:
    """Compare JSON; the string of three dots stands for anything."""
    if isinstance(shown, dict):
        assert isinstance(found, dict), place
        assert set(found) == set(shown), f"{place}: {found}"
        for name in shown:
            matches(found[name], shown[name], f"{place} {name}")
    elif shown != "...":
        assert found == shown, place


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    [
        # The training page trains and evaluates: most of a minute.
        pytest.param(page, marks=[pytest.mark.long] if page.name == "training.md" else [])
        for page in RUNNABLE
    ],
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_snippets_run(
    page: Path, service: str, serve: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All snippets of a page run in their order and print what the page shows."""
    folder = tmp_path / "folder"
    shutil.copytree(ROOT / "examples", folder / "examples")
    monkeypatch.chdir(folder)
    text = page.read_text("utf-8")
    for name, make in FILES.items():
        if re.search(rf"(?<![\w-]){re.escape(name)}\b", text):
            make(folder / name)
    shared = Page(folder, service, serve, in_bash=page.name == "README.md")
    monkeypatch.setenv("PUGEO_URL", service)
    missing = set()
    for snippet in snippets(page, ROOT):
        if snippet.needs and not there(snippet.needs):
            missing.add(snippet.needs)
        elif snippet.language in RUN:
            shared.run(snippet)
    if missing:
        pytest.skip(f"all but the snippets that need {', '.join(sorted(missing))}")


def there(name: str) -> bool:
    """Whether a command or a Python module is installed."""
    return shutil.which(name) is not None or importlib.util.find_spec(name) is not None


@pytest.mark.parametrize("page", pages(ROOT), ids=lambda page: str(page.relative_to(ROOT)))
def test_languages(page: Path) -> None:
    """Each fenced block has a language, and those that could be run are."""
    for snippet in snippets(page, ROOT):
        assert snippet.language in RUN | SHOWN, snippet.place
