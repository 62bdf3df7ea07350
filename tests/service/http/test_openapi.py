# SPDX-License-Identifier: Apache-2.0
"""The OpenAPI document is complete and equal to the committed one."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from pugeo_model.formats import FORMATS, WRITABLE
from pugeo_service.app import create_app
from pugeo_service.http.auth import is_open
from pugeo_service.problems import MEDIA_TYPE
from pugeo_service.settings import Settings


@pytest.fixture
def document(tmp_path: Path) -> dict[str, Any]:
    """The document of a service."""
    return create_app(Settings(engine="inline", spool_dir=tmp_path)).openapi()


def operations(document: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Path and operation of each route."""
    return [(path, each) for path, many in document["paths"].items() for each in many.values()]


def formats_of(document: dict[str, Any], path: str) -> list[dict[str, Any]]:
    """Entries of x-formats, copied: the description of the body is shared by all documents."""
    return [dict(each) for each in document["paths"][path]["post"]["requestBody"]["x-formats"]]


def test_the_committed_document_is_this_one(root: Path) -> None:
    """The committed document is up to date (`make openapi`)."""
    command = [sys.executable, "-m", "pugeo_service.app"]
    made = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert json.loads((root / "docs/openapi.json").read_text("utf-8")) == json.loads(made)


def test_every_error_is_a_problem(document: dict[str, Any]) -> None:
    """Every error response is a problem document, also for validation errors."""
    for path, operation in operations(document):
        for status, answer in operation["responses"].items():
            if int(status) >= 400:
                assert list(answer["content"]) == [MEDIA_TYPE], (path, status)
                schema = answer["content"][MEDIA_TYPE]["schema"]
                assert schema == {"$ref": "#/components/schemas/Problem"}
    assert "HTTPValidationError" not in document["components"]["schemas"]


def test_every_route_says_whether_it_needs_a_key(document: dict[str, Any]) -> None:
    """Each route that needs a key names both schemes and 401."""
    assert set(document["components"]["securitySchemes"]) == {"bearer", "key"}
    for path, operation in operations(document):
        assert ("security" in operation) == (not is_open(path)), path
        assert ("401" in operation["responses"]) == (not is_open(path)), path


@pytest.mark.parametrize("path", ["/jobs", "/jobs/{job_id}", "/upsample"])
def test_a_wrong_method_names_the_right_ones(document: dict[str, Any], path: str) -> None:
    """The Allow header of a 405 lists the methods in the document, and HEAD beside GET."""
    client = TestClient(create_app(Settings(engine="inline")))
    answer = client.options(path.format(job_id="0"))
    assert answer.status_code == 405
    allowed = {method.lower() for method in answer.headers["allow"].split(", ")}
    described = set(document["paths"][path])
    assert allowed == described | ({"head"} if "get" in described else set())


def test_operations_are_named(document: dict[str, Any]) -> None:
    """Each operation has a stable id and a description."""
    ids = [operation["operationId"] for _, operation in operations(document)]
    assert len(set(ids)) == len(ids)
    assert all(name.replace("_", "").isalpha() and name.islower() for name in ids), ids
    assert all(operation["description"] for _, operation in operations(document))


def test_references_lead_somewhere(document: dict[str, Any]) -> None:
    """Every $ref names an existing part."""

    def references(value: Any) -> list[str]:
        if isinstance(value, dict):
            here = [value["$ref"]] if isinstance(value.get("$ref"), str) else []
            return here + [each for inner in value.values() for each in references(inner)]
        if isinstance(value, list):
            return [each for inner in value for each in references(inner)]
        return []

    for reference in references(document):
        found: Any = document
        for part in reference.removeprefix("#/").split("/"):
            found = found[part]


@pytest.mark.parametrize("path", ["/jobs", "/upsample"])
def test_formats_are_listed(document: dict[str, Any], path: str) -> None:
    """Each format that is read is listed with its suffixes, and marked where it is written too."""
    listed = {each.pop("name"): each for each in formats_of(document, path)}
    assert listed == {
        name: {"extensions": list(module.EXTENSIONS), "written": name in WRITABLE}
        for name, module in FORMATS.items()
    }
    assert next(iter(listed)) == "ply"


def test_the_deadline_is_described(document: dict[str, Any]) -> None:
    """Prefer: wait is documented at /upsample."""
    parameters = document["paths"]["/upsample"]["post"]["parameters"]
    assert {"Prefer", "X-Request-ID"} <= {parameter["name"] for parameter in parameters}
