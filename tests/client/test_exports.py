# SPDX-License-Identifier: Apache-2.0
import inspect

import pytest

import pugeo_client
from pugeo_client import AsyncClient, Client


def test_every_public_name_is_there() -> None:
    """Every name in `__all__` can be imported, and `dir` lists the same."""
    assert sorted(pugeo_client.__all__) == dir(pugeo_client)
    for name in pugeo_client.__all__:
        assert getattr(pugeo_client, name) is not None
    with pytest.raises(AttributeError, match="nothing_such"):
        getattr(pugeo_client, "nothing_such")  # noqa: B009 - mypy would see it


def test_both_clients_have_equal_signatures() -> None:
    """The methods of both clients have the same names and parameters."""

    def surface(kind: type) -> dict[str, list[str]]:
        return {
            name: [str(parameter) for parameter in inspect.signature(method).parameters.values()]
            for name, method in inspect.getmembers(kind, inspect.isfunction)
            if not name.startswith("_")
        }

    ours, theirs = surface(Client), surface(AsyncClient)
    assert theirs.pop("aclose") == ours.pop("close")
    assert ours == theirs


def test_the_module_function_calls_the_client(monkeypatch: pytest.MonkeyPatch) -> None:
    """`pugeo_client.upsample` goes to PUGEO_URL with the options it was given."""
    seen: list[object] = []

    def record(self: Client, src: object, ratio: float, **options: object) -> None:
        seen.extend([self.base_url, src, ratio, options])

    monkeypatch.setenv("PUGEO_URL", "http://far:1")
    monkeypatch.setattr(Client, "upsample", record)
    pugeo_client.upsample("a.ply", 4, seed=3)
    assert seen == ["http://far:1", "a.ply", 4, {"seed": 3}]
