# SPDX-License-Identifier: Apache-2.0
"""Rules of the front process that type checkers do not know."""

import ast
from pathlib import Path

from pugeo_service.app import create_app
from pugeo_service.http.query import UpsampleQuery
from pugeo_service.problems import MEDIA_TYPE
from pugeo_service.settings import Settings


def test_no_middleware_hides_the_disconnect(root: Path) -> None:
    """No middleware of a kind that hides disconnects from routes is used."""
    for path in (root / "service").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom):
                names = {alias.name for alias in node.names}
                assert "BaseHTTPMiddleware" not in names, path
            if isinstance(node, ast.Attribute):
                assert node.attr != "middleware", f"{path}:{node.lineno}"


def test_nothing_prints(root: Path) -> None:
    """The service logs and never prints."""
    for path in (root / "service").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id != "print", f"{path}:{node.lineno}"


def test_the_schema_tells_the_contract() -> None:
    """The document has all operations, and all options and problems of /upsample."""
    schema = create_app(Settings(engine="inline")).openapi()
    ids = {
        operation["operationId"] for path in schema["paths"].values() for operation in path.values()
    }
    assert ids == {
        "upsample", "list_models", "get_model", "health", "health_live", "health_ready", "metrics",
        "submit_job", "list_jobs", "get_job", "job_events", "job_result", "delete_job",
        "preview",
    }  # fmt: skip
    upsample = schema["paths"]["/upsample"]["post"]
    in_query = {each["name"] for each in upsample["parameters"] if each["in"] == "query"}
    assert in_query == set(UpsampleQuery.model_fields)
    assert "multipart/form-data" in upsample["requestBody"]["content"]
    assert "application/ply" in upsample["responses"]["200"]["content"]
    for status in ("400", "406", "408", "413", "415", "422", "500", "503", "504"):
        assert list(upsample["responses"][status]["content"]) == [MEDIA_TYPE], status


def test_no_page_loads_from_elsewhere() -> None:
    """FastAPI's own documentation pages, which need the internet, are off."""
    app = create_app(Settings(engine="inline"))
    assert app.docs_url is None
    assert app.redoc_url is None
