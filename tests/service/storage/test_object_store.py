# SPDX-License-Identifier: Apache-2.0
"""A store of whole files, in a folder, in memory and on a server of S3."""

import time
from pathlib import Path

import pytest

from pugeo_service.storage.object_store import ObjectStore, StoreError

SOON = 3600.0


def test_what_is_put_is_got(store_url: str, tmp_path: Path) -> None:
    """A file comes back with its bytes, and is gone once it is removed."""
    store, path, back = ObjectStore(store_url), tmp_path / "here", tmp_path / "back"
    path.write_bytes(bytes(range(256)) * 1000)
    store.put(path, "inputs/one")
    store.get("inputs/one", back)
    assert back.read_bytes() == path.read_bytes()
    for _ in range(2):
        store.remove("inputs/one")
    with pytest.raises(FileNotFoundError):
        store.get("inputs/one", back)


def test_a_large_file(store_url: str, tmp_path: Path) -> None:
    """A file of several parts comes back whole."""
    store, path, back = ObjectStore(store_url), tmp_path / "here", tmp_path / "back"
    path.write_bytes(bytes(range(256)) * (1 << 18))
    store.put(path, "results/one/digest")
    store.get("results/one/digest", back)
    assert back.read_bytes() == path.read_bytes()


def test_old_names(store_url: str, tmp_path: Path) -> None:
    """Names that are old and not kept are found, each once, and removed with what is below."""
    store, path = ObjectStore(store_url), tmp_path / "here"
    path.write_bytes(b"x")
    assert store.old("results", set(), time.time()) == []
    for key in ("results/one/a", "results/one/b", "results/two/a", "results/three"):
        store.put(path, key)
    now = time.time()
    assert store.old("results", {"two"}, now - SOON) == []
    assert sorted(store.old("results", {"two"}, now + SOON)) == ["one", "three"]
    store.remove("results/one")
    assert store.old("results", {"two"}, now + SOON) == ["three"]


def test_a_store_that_cannot_be_reached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each operation raises an error of the store, without its key or password."""
    pytest.importorskip("s3fs")
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://user:hidden-word@127.0.0.1:9")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "anybody")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "hidden-word")
    monkeypatch.setattr("s3fs.core.S3FileSystem.retries", 1)
    store, path = ObjectStore("s3://nowhere/jobs"), tmp_path / "here"
    path.write_bytes(b"x")
    for operation in (
        lambda: store.put(path, "inputs/one"),
        lambda: store.get("inputs/one", path),
        lambda: store.old("inputs", set(), 0.0),
    ):
        with pytest.raises(StoreError) as raised:
            operation()
        assert "hidden-word" not in str(raised.value)


def test_a_bucket_that_does_not_exist(
    s3_server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Putting a file into it is an error of the store."""
    monkeypatch.setenv("AWS_ENDPOINT_URL", s3_server)
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "anybody")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "hidden-word")
    path = tmp_path / "here"
    path.write_bytes(b"x")
    with pytest.raises(StoreError, match="inputs/one"):
        ObjectStore("s3://no-such-bucket/jobs").put(path, "inputs/one")
