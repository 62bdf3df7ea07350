# SPDX-License-Identifier: Apache-2.0
"""Rules of the house that no single module can keep."""

import ast
import re
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGES = {"pugeo_client": "client", "pugeo_model": "model", "pugeo_service": "service"}
MOST_LINES = 400
# Everything else stays importable, and starts fast, without torch.
TORCH_HOMES = ("pugeo_model/network/", "pugeo_model/training/", "pugeo_model/weights.py")


def sources(root: Path, *folders: str) -> Iterator[Path]:
    for folder in folders:
        yield from sorted((root / folder).rglob("*.py"))


def run(code: str, root: Path) -> str:
    """Run code in a fresh interpreter that finds the packages, and return what it prints."""
    command = [sys.executable, "-I", "-c", f"import sys; sys.path[:0] = {_paths(root)}; {code}"]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def _paths(root: Path) -> list[str]:
    return [str(root / home) for home in PACKAGES.values()]


@pytest.fixture(scope="session")
def wheel(root: Path, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Names of the files in the wheel."""
    from hatchling.builders.wheel import WheelBuilder

    built = WheelBuilder(str(root)).build(directory=str(tmp_path_factory.mktemp("wheel")))
    return zipfile.ZipFile(next(iter(built))).namelist()


def test_the_wheel_is_whole(wheel: list[str], root: Path) -> None:
    """Every module, the weights and their cards, and the type markers are in the wheel."""
    for package, home in PACKAGES.items():
        for path in (root / home / package).rglob("*"):
            if path.suffix in {".py", ".safetensors", ".json"} or path.name == "py.typed":
                assert path.relative_to(root / home).as_posix() in wheel
        assert f"{package}/py.typed" in wheel
    assert "pugeo_model/released/standard.safetensors" in wheel
    assert "pugeo_model/released/standard.json" in wheel
    assert any(name.endswith("licenses/LICENSE") for name in wheel)


def test_the_wheel_has_nothing_else(wheel: list[str]) -> None:
    """No test, cache or script of this repository lands among other people's packages."""
    homes = {name.split("/")[0] for name in wheel}
    assert {home for home in homes if not home.endswith(".dist-info")} == set(PACKAGES)
    assert not [name for name in wheel if "__pycache__" in name]


def test_one_version(root: Path) -> None:
    """The three packages and the distribution tell the same version."""
    version = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    names = ", ".join(PACKAGES)
    told = run(f"import {names}; print(*(m.__version__ for m in ({names})))", root)
    assert set(told.split()) == {version}


def test_the_client_is_light(root: Path) -> None:
    """`import pugeo_client` loads the standard library alone: numpy and HTTP come when used."""
    # Coverage and the start of the interpreter load modules too.
    code = "before = set(sys.modules); import pugeo_client; print(*(set(sys.modules) - before))"
    loaded = run(code, root).split()
    ours = {name for name in loaded if name.startswith("pugeo_client")}
    others = {name.partition(".")[0] for name in loaded} - set(sys.stdlib_module_names)
    assert others == {"pugeo_client"}
    assert len(ours) <= 3


@pytest.mark.parametrize(
    ("imports", "banned"),
    [
        ("pugeo_client._client, pugeo_client._aclient", {"torch", "scipy", "pugeo_model"}),
        ("pugeo_model, pugeo_model.formats", {"torch", "fastapi", "starlette", "httpx2"}),
        ("pugeo_service.app, pugeo_service.server", {"torch", "pugeo_client"}),
    ],
)
def test_what_an_import_brings_along(root: Path, imports: str, banned: set[str]) -> None:
    """The clients work without the model, the model without HTTP, and the front without torch."""
    assert not banned & set(run(f"import {imports}; print(*sys.modules)", root).split())


def test_options_are_light(root: Path) -> None:
    """Importing the options loads neither torch nor numba nor scipy."""
    heavy = {"torch", "numba", "scipy"}
    assert not heavy & set(run("import pugeo_model.options; print(*sys.modules)", root).split())


def test_torch_has_its_homes(root: Path) -> None:
    """Only the network, its training and its weights import torch, at the top or within."""
    strangers = []
    for path in sources(root, *PACKAGES.values()):
        names = {
            name.split(".")[0]
            for node in ast.walk(ast.parse(path.read_text("utf-8")))
            for name in _imported(node)
        }
        inside = path.relative_to(root).as_posix().partition("/")[2]
        if "torch" in names and not inside.startswith(TORCH_HOMES):
            strangers.append(inside)
    assert strangers == []


def _imported(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom) and node.module and not node.level:
        return [node.module]
    return []


def test_modules_stay_short(root: Path) -> None:
    """A module that no longer fits into one reading wants to be two."""
    folders = [*PACKAGES.values(), "tests", "examples", "deploy", "benchmarks"]
    lengths = {path: len(path.read_bytes().splitlines()) for path in sources(root, *folders)}
    assert {str(path): lines for path, lines in lengths.items() if lines > MOST_LINES} == {}


def test_every_file_names_its_licence(root: Path) -> None:
    """The first line of each source file is its SPDX identifier."""
    folders = [*PACKAGES.values(), "tests", "examples", "deploy", "benchmarks"]
    without = [
        str(path)
        for path in sources(root, *folders)
        if not path.read_text("utf-8").startswith("# SPDX-License-Identifier: Apache-2.0\n")
    ]
    assert without == []


def test_every_test_says_what_it_proves(root: Path) -> None:
    """A test without a sentence is a test that nobody can judge."""
    silent = [
        f"{path.name}:{node.lineno} {node.name}"
        for path in sources(root, "tests")
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and node.name.startswith("test_")
        and not ast.get_docstring(node)
    ]
    assert silent == []


_QUESTION = re.compile(r"(What|Who|Whose|Whoever|Where|Whether|How|When|Which|Why)\b")


def test_docstrings_name_the_thing(root: Path) -> None:
    """A docstring starts with what the thing is or does, not with a question word.

    "Whether" is the usual word for a predicate, and stays allowed for functions that return bool.
    """
    asking = []
    for path in sources(root, *PACKAGES.values(), "benchmarks", "examples", "deploy"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if not isinstance(
                node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
            ):
                continue
            first = (ast.get_docstring(node) or "").partition("\n")[0]
            returns = getattr(node, "returns", None)
            predicate = returns is not None and "bool" in ast.unparse(returns)
            if _QUESTION.match(first) and not (predicate and first.startswith("Whether")):
                asking.append(f"{path.name}: {first}")
    assert asking == []


def test_errors_end_in_error(root: Path) -> None:
    """Every exception class is called ...Error."""
    bases = {"Exception", "ValueError", "RuntimeError", "OSError", "TypeError", "KeyError"}
    classes = [
        node
        for path in sources(root, *PACKAGES.values())
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.ClassDef)
    ]
    raised = {node.name for node in classes if bases & {ast.unparse(b) for b in node.bases}}
    raised |= {n.name for n in classes if raised & {ast.unparse(b) for b in n.bases}}
    raised |= {n.name for n in classes if any(ast.unparse(b).endswith("Error") for b in n.bases)}
    assert len(raised) > 20
    assert [name for name in sorted(raised) if not name.endswith("Error")] == []


def test_a_name_has_one_meaning(root: Path) -> None:
    """No two public classes of the model and the service share a name.

    A format is a package of its own, in which a header is that of its files.
    """
    seen: dict[str, Path] = {}
    twice = []
    for path in sources(root, "model", "service"):
        if "formats" in path.parts:
            continue
        for node in ast.parse(path.read_text("utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                if node.name in seen:
                    twice.append(f"{node.name}: {seen[node.name]} and {path}")
                seen[node.name] = path
    assert not twice


def test_no_test_measures_wall_clock_time(root: Path) -> None:
    """A busy machine must not fail a test: no assertion compares a clock with a number."""
    # A loop that waits may bound its patience ("< end"); a figure of speed may not be a bound.
    clock = re.compile(r"assert .*(perf_counter|monotonic|elapsed|took).*[<>] (?!end\b)")
    found = [
        f"{path.name}: {line.strip()}"
        for path in sources(root, "tests")
        for line in path.read_text("utf-8").splitlines()
        if clock.search(line) and path.name != "test_house.py"
    ]
    assert found == []


def test_no_middleware_that_hides_disconnects(root: Path) -> None:
    """Starlette's BaseHTTPMiddleware never lets a route see that its client left."""
    banned = re.compile(r"import.*BaseHTTPMiddleware|\(BaseHTTP|\.middleware\(\s*[\"']http")
    found = [str(p) for p in sources(root, "service") if banned.search(p.read_text("utf-8"))]
    assert found == []


def test_no_gpl_at_run_time(root: Path) -> None:
    """GPL code (plyfile) may judge our own reader in tests, and is no part of what we ship."""
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    extras = {name: " ".join(needs) for name, needs in project["optional-dependencies"].items()}
    assert [name for name, needs in extras.items() if "plyfile" in needs] == ["dev"]
    for path in sources(root, *PACKAGES.values(), "examples", "benchmarks"):
        assert "plyfile" not in path.read_text("utf-8"), path
    assert "cgal" not in " ".join(extras.values()).lower()
    for path in sources(root, *PACKAGES.values(), "examples"):
        assert "CGAL" not in path.read_text("utf-8"), path


def test_constraints_cover_what_is_asked_for(root: Path) -> None:
    """Each direct dependency has an exact version, so that two installs are the same."""
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    asked = project["dependencies"] + [
        need for needs in project["optional-dependencies"].values() for need in needs
    ]
    text = (root / "constraints.txt").read_text("utf-8")
    pinned = {_name(line) for line in text.splitlines() if re.match(r"[\w.-]+==[\w.]+$", line)}
    assert {_name(need) for need in asked} - {"pugeo"} <= pinned
    assert "+" not in text


def test_the_parser_of_forms_is_new_enough(root: Path) -> None:
    """Versions of python-multipart before 0.0.18 let a small body use much time of a processor."""
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    needs = [need for many in project["optional-dependencies"].values() for need in many]
    found = [need for need in needs if _name(need) == "python-multipart"]
    assert len(found) == 1
    lowest = re.search(r">=([\d.]+)", found[0])
    assert lowest is not None
    assert tuple(map(int, lowest[1].split("."))) >= (0, 0, 18)


def _name(requirement: str) -> str:
    match = re.match(r"[\w.-]+", requirement)
    assert match is not None
    return re.sub(r"[-_.]+", "-", match[0]).lower()


def test_one_torch(root: Path) -> None:
    """The Makefile, the image and the constraints agree on the version of torch."""
    found = {
        *re.findall(r"TORCH_VERSION \?= (.+)", (root / "Makefile").read_text("utf-8")),
        *re.findall(r"TORCH_VERSION=([\d.]+)", (root / "Dockerfile").read_text("utf-8")),
        *re.findall(r"^torch==(.+)", (root / "constraints.txt").read_text("utf-8"), re.MULTILINE),
    }
    assert len(found) == 1
