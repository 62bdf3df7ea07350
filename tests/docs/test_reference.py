# SPDX-License-Identifier: Apache-2.0
"""The reference lists all that the code has, and nothing that it has not."""

import ast
import inspect
import json
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
import typer
from pydantic import TypeAdapter

import pugeo_client
from pugeo_client import errors
from pugeo_model import cli
from pugeo_model.formats import FORMATS
from pugeo_service import problems
from pugeo_service.cli import serve
from pugeo_service.http.query import UpsampleQuery
from pugeo_service.jobs.models import State
from pugeo_service.settings import Settings

ROOT = Path(__file__).resolve().parents[2]
REFERENCE = ROOT / "docs" / "reference"
_CODE = re.compile(r"`([^`]+)`")


def page(name: str) -> str:
    """The text of a page of the reference."""
    return (REFERENCE / name).read_text("utf-8")


def rows(text: str) -> Iterator[list[str]]:
    """Cells of all rows of the tables on a page, heads left out."""
    for line in text.splitlines():
        if line.startswith("| ") and not re.fullmatch(r"[|:\- ]+", line):
            yield [cell.strip() for cell in line.strip().strip("|").split("|")]


def sources() -> Iterator[Path]:
    """All modules of the packages."""
    for package in ("client/pugeo_client", "model/pugeo_model", "service/pugeo_service"):
        yield from (ROOT / package).rglob("*.py")


@pytest.fixture(scope="module")
def identifiers() -> set[str]:
    """Every name in the code: modules, classes, functions, arguments, variables, attributes."""
    found: set[str] = set()
    for path in sources():
        found.update((path.stem, path.parent.name))
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            for attribute in ("name", "id", "arg", "attr"):
                value = getattr(node, attribute, None)
                if isinstance(value, str):
                    found.add(value)
    return found


def test_glossary(identifiers: set[str]) -> None:
    """Each name in the second column of the glossary is one of the code."""
    terms = [row for row in rows(page("glossary.md")) if len(row) == 3]
    named = {name for row in terms for name in _CODE.findall(row[1])}
    assert len(named) > 60
    assert sorted(named - identifiers) == []


def test_each_term_has_one_meaning() -> None:
    """No term of the glossary is listed twice."""
    terms = [row[0] for row in rows(page("glossary.md")) if not row[0].startswith("term")]
    assert sorted(terms) == sorted(set(terms))


def test_settings() -> None:
    """Each setting is listed with the option that `pugeo serve` has for it, and its default."""
    listed = {row[0].strip("`"): row[1:] for row in rows(page("settings.md")) if len(row) == 4}
    listed.pop("variable")
    options = inspect.signature(serve).parameters
    assert set(listed) == {f"PUGEO_{name.upper()}" for name in Settings.model_fields}
    for name, field in Settings.model_fields.items():
        option, default, _ = listed[f"PUGEO_{name.upper()}"]
        assert option == (f"`--{name.replace('_', '-')}`" if name in options else ""), name
        if default.startswith("`") and name != "jobs_dir":
            read = TypeAdapter(type(field.default)).validate_python(default.strip("`"))
            assert read == field.default, name
        elif default == "":
            assert field.default in (None, ()), name


def test_options() -> None:
    """Each option of a request is listed by the name that it has in REST, and no other."""
    listed = {_CODE.findall(row[1])[0].partition("=")[0] for row in rows(page("options.md"))
              if len(row) == 4 and row[0].startswith("`")}  # fmt: skip
    assert listed == set(UpsampleQuery.model_fields) - {"format"}


def test_formats() -> None:
    """Each format is listed with its suffixes and media types, and no other."""
    listed = {row[0].strip("`"): row for row in rows(page("formats.md")) if len(row) == 4}
    listed.pop("name")
    assert set(listed) == set(FORMATS)
    for name, module in FORMATS.items():
        assert listed[name][1].strip("`").split() == list(module.EXTENSIONS), name
        assert _CODE.findall(listed[name][2]) == list(module.MEDIA_TYPES), name


def test_command_line() -> None:
    """Each option of each command is on the page."""
    text = page("command-line.md")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        commands: Any = typer.main.get_command(cli.app)
    for name, command in commands.commands.items():
        section = text.partition(f"## pugeo {name}\n")[2].partition("\n## ")[0]
        assert section, name
        for parameter in command.params:
            for option in parameter.opts:
                if parameter.param_type_name == "option" and option != "--help":
                    assert re.search(rf"(?<![\w-]){option}\b", section), f"pugeo {name} {option}"


def _values(node: ast.expr) -> list[str]:
    constants = [n.value for n in ast.walk(node) if isinstance(n, ast.Constant)]
    return [value for value in constants if isinstance(value, str)]


def codes() -> set[str]:
    """The codes of all problems that the code names: second argument, ``code=``, or a class's."""
    found = set(problems._CODE.values())
    for path in sources():
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call):
                name = getattr(node.func, "id", getattr(node.func, "attr", ""))
                if name == "ProblemError" and len(node.args) > 1:
                    found.update(_values(node.args[1]))
                elif name.endswith("Error"):
                    for keyword in node.keywords:
                        if keyword.arg == "code":
                            found.update(_values(keyword.value))
            elif isinstance(node, ast.ClassDef) and node.name.endswith("Error"):
                for line in node.body:
                    if isinstance(line, ast.Assign) and ast.unparse(line.targets[0]) == "code":
                        found.update(_values(line.value))
    return {code for code in found if re.fullmatch(r"[a-z]+(_[a-z]+)*", code)}


def test_error_codes() -> None:
    """Each code of an error is in the table, and each code of the table is in the code."""
    listed = {code for row in rows(page("errors.md")) if row[0].isdigit()
              for code in _CODE.findall(row[1])}  # fmt: skip
    inside = {"bad_request", "cloud_error", "http_error"}  # never sent: every case has its own
    assert codes() - inside - {"code"} == listed


def test_exceptions_of_the_client() -> None:
    """The tree of the page has every exception of the SDK, and no other."""
    tree = page("errors.md").partition("```text\n")[2].partition("```")[0]
    assert set(re.findall(r"\w+Error\b", re.sub(r"\(also.*", "", tree))) == set(errors.__all__)


def test_exceptions_of_the_model() -> None:
    """The table has every exception of the model with the status that the service gives it."""
    listed = {row[0].strip("`"): int(row[2]) for row in rows(page("errors.md"))
              if row[0].endswith("Error`")}  # fmt: skip
    assert listed == {kind.__name__: status for kind, status in problems._STATUS.items()}


def test_routes() -> None:
    """Each route of the OpenAPI document is in the table of routes, and no other."""
    document = json.loads((ROOT / "docs" / "openapi.json").read_text("utf-8"))
    there = {f"{method.upper()} {path}" for path, methods in document["paths"].items()
             for method in methods}  # fmt: skip
    table = page("rest.md").partition("## Routes")[2].partition("\n## ")[0]
    listed = {route for row in rows(table) for route in re.findall(r"`([A-Z]+ /[^`]*)`", row[0])}
    assert listed == there


def test_public_names_of_the_client() -> None:
    """Each public name of the SDK is on its page."""
    text = page("client.md")
    for name in set(pugeo_client.__all__) - {"__version__", "errors"}:
        assert re.search(rf"^::: pugeo_client\.(\w+\.)?{name}$", text, re.MULTILINE), name


def test_decisions() -> None:
    """The index of decisions has each page with the page's own title."""
    folder = ROOT / "docs" / "decisions"
    listed = re.findall(r"\| (\d+) \| \[(.+)\]\((.+)\) \|", (folder / "index.md").read_text())
    assert {name for _, _, name in listed} == {p.name for p in folder.glob("[0-9]*.md")}
    for number, title, name in listed:
        assert (folder / name).read_text().startswith(f"# {number}. {title}\n"), name


def test_states_of_a_job() -> None:
    """The page of REST names every state of a job."""
    row = next(row for row in rows(page("rest.md")) if "`state`:" in row[1])
    assert set(get_args(State)) <= set(_CODE.findall(row[1]))


def test_files_of_the_architecture() -> None:
    """Each module and folder that ARCHITECTURE.md names is there."""
    text = (ROOT / "ARCHITECTURE.md").read_text("utf-8")
    folders = ("client", "model", "service", "benchmarks", "tests")
    there = [f"/{path.relative_to(ROOT).as_posix()}"
             for folder in folders for path in (ROOT / folder).rglob("*")]  # fmt: skip
    modules = set(re.findall(r"[\w/]+\.py\b", text))
    named = sorted(modules | set(re.findall(r"^  (\w+)/ ", text, re.MULTILINE)))
    assert len(named) > 30
    assert [name for name in named if not any(t.endswith(f"/{name}") for t in there)] == []


def test_names_of_the_architecture(identifiers: set[str]) -> None:
    """Each name in code style in ARCHITECTURE.md that looks like one is in the code."""
    text = (ROOT / "ARCHITECTURE.md").read_text("utf-8")
    named = {name for code in _CODE.findall(text) for name in re.findall(r"^[A-Za-z_]\w+$", code)}
    shown = {"MEDIA_TYPES", "worker_lost", "fast", "numpy"}
    assert sorted(named - identifiers - shown) == []
