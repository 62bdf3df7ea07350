# SPDX-License-Identifier: Apache-2.0
"""Files in a store that all fronts of a service reach: S3, a folder, or another one of fsspec."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import fsspec

__all__ = ["ObjectStore", "StoreError"]

_S3 = frozenset({"s3", "s3a"})
# Of each connection and answer. Without them a store that is cut off holds a request for minutes.
_S3_OPTIONS = {"config_kwargs": {"connect_timeout": 5, "read_timeout": 30}}
_USER = re.compile(r"//[^/@\s]*@")


class StoreError(OSError):
    """The store cannot be reached, or refuses what is asked of it."""


class ObjectStore:
    """Whole files under keys such as ``inputs/7f3a``.

    Addresses and credentials are those of fsspec and its backends, for S3 the environment variables
    ``AWS_*``. Its methods wait for the network, so call them in threads.

    Args:
        url: for example ``s3://bucket/prefix``.
    """

    def __init__(self, url: str) -> None:
        protocol = url.partition("://")[0]
        # Listings would be remembered, which other processes change, and so would be connections.
        options: dict[str, Any] = {"use_listings_cache": False, "skip_instance_cache": True}
        if protocol in _S3:
            options |= _S3_OPTIONS
        elif protocol in {"file", "local"}:
            options["auto_mkdir"] = True
        with _store_errors("the store cannot be used"):
            self._files, root = fsspec.url_to_fs(url, **options)
        self._root = root.rstrip("/")

    def put(self, path: Path, key: str) -> None:
        """Store a file under a key.

        Raises:
            StoreError: it is not stored, or not whole.
        """
        try:
            with _store_errors(f"{key} cannot be stored"):
                self._files.put_file(str(path), self._path(key))
                size = self._files.info(self._path(key))["size"]
        except FileNotFoundError as error:
            raise StoreError(f"{key} cannot be stored: the place does not exist") from error
        if size != path.stat().st_size:
            raise StoreError(f"{key} is stored with {size} bytes")

    def get(self, key: str, path: Path) -> None:
        """Write what is stored under a key to a file.

        Raises:
            FileNotFoundError: nothing is stored under it.
            StoreError: it cannot be read.
        """
        with _store_errors(f"{key} cannot be read"):
            self._files.get_file(self._path(key), str(path))

    def remove(self, key: str) -> None:
        """Remove what is stored under a key and below it, if anything is.

        Raises:
            StoreError: it cannot be removed.
        """
        with _store_errors(f"{key} cannot be removed"):
            try:
                self._files.rm(self._path(key), recursive=True)
            except FileNotFoundError:
                return

    def old(self, folder: str, kept: set[str], before: float) -> list[str]:
        """Return the names in a folder that are not among ``kept`` and were stored before a time.

        Args:
            folder: such as ``inputs``.
            kept: names that are not returned.
            before: seconds since 1970, by the clock of the store.

        Raises:
            StoreError: the folder cannot be listed.
        """
        place = self._path(folder)
        found: dict[str, float] = {}
        with _store_errors(f"{folder} cannot be listed"):
            try:
                paths = self._files.find(place)
            except FileNotFoundError:
                return []
            for path in paths:
                name = path.rpartition(f"{place}/")[2].partition("/")[0]
                if name not in kept:
                    stored = self._files.modified(path).timestamp()
                    found[name] = max(stored, found.get(name, 0.0))
        return [name for name, stored in found.items() if stored <= before]

    def _path(self, key: str) -> str:
        return f"{self._root}/{key}"


@contextmanager
def _store_errors(what: str) -> Iterator[None]:
    """Raise errors of all backends as `StoreError`, apart from a missing file.

    Raises:
        StoreError: names the error; an address in it loses its user and password.
    """
    try:
        yield
    except FileNotFoundError:
        raise
    except Exception as error:
        text = _USER.sub("//", " ".join(str(error).split()))[:200]
        raise StoreError(f"{what}: {type(error).__name__}: {text}") from error
