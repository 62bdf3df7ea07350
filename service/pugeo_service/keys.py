# SPDX-License-Identifier: Apache-2.0
"""API keys: who may come in, and under which name.

A key is 256 random bits, so that nobody finds one by guessing, and nobody finds one from its
hash either. That is why plain SHA-256 is right here: slow hashes (argon2, bcrypt) protect words
that people choose, and would only make each request slower. The service knows hashes alone; a
copy of its file opens nothing.
"""

import hashlib
import hmac
import re
import secrets
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import structlog

__all__ = ["Entry", "Keys", "hash_of", "new_token", "owner_of", "parse"]

_log = structlog.stdlib.get_logger("pugeo.keys")
# Names go into logs and into the account of the queue.
_ENTRY = re.compile(r"(?P<name>[A-Za-z0-9._-]{1,64}):(?P<digest>[0-9a-f]{64})")
_PREFIX = "pugeo_"


class _HasScope(Protocol):
    scope: Any


def owner_of(request: _HasScope) -> str:
    """Return the name of the key that a request came with; ``""`` where no keys are asked for."""
    return str(request.scope.get("state", {}).get("owner", ""))


def new_token() -> str:
    """Make a token: a prefix that scanners for leaked secrets can find, and 256 random bits."""
    return _PREFIX + secrets.token_urlsafe(32)


def hash_of(token: str) -> str:
    """Return what is kept of a token: SHA-256 in hexadecimal."""
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).hexdigest()


@dataclass(frozen=True)
class Entry:
    """One key that opens the service.

    Attributes:
        name: its owner. Several keys may share a name: the old and the new one in a rotation.
        digest: SHA-256 of the token, hexadecimal.
    """

    name: str
    digest: str

    def __str__(self) -> str:
        return f"{self.name}:{self.digest}"


def parse(lines: Iterable[str]) -> tuple[Entry, ...]:
    """Read entries ``name:sha256``; empty lines and those that begin with ``#`` are skipped.

    Raises:
        ValueError: an entry has another form; the message says which line, and not what it
            holds, since that may be a token put there by mistake.
    """
    entries = []
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        match = _ENTRY.fullmatch(text)
        if match is None:
            raise ValueError(
                f"entry {number} is not NAME:SHA256 (64 hexadecimal digits, lower case); "
                "`pugeo keys new NAME` prints one"
            )
        entries.append(Entry(match["name"], match["digest"]))
    return tuple(entries)


class Keys:
    """The keys that are valid now.

    The file is read again when it changes, so that keys come and go without a restart. A file
    that is missing or empty lets nobody in; one that cannot be understood changes nothing.

    Args:
        file: file of entries, or ``None``.
        fixed: entries of the settings, or ``None``. Where both are ``None``, no keys are asked
            for.
    """

    def __init__(self, file: Path | None, fixed: tuple[Entry, ...] | None) -> None:
        self.required = file is not None or fixed is not None
        self._file = file
        self._fixed = fixed or ()
        self._read: tuple[Entry, ...] = ()
        self._stamp: object = ()
        self._refresh()

    def owner(self, headers: Mapping[str, str]) -> str | None:
        """Return the name of the key that a request's headers hold, or ``None``."""
        self._refresh()
        token = _token(headers)
        given = hash_of(token)
        found = None
        # All of them, always: the time taken must not tell which one matched.
        for entry in (*self._fixed, *self._read):
            if hmac.compare_digest(entry.digest, given):
                found = entry.name
        return found if token else None

    def _refresh(self) -> None:
        if self._file is None:
            return
        stamp = _stamp(self._file)
        if stamp == self._stamp:
            return
        self._stamp = stamp
        try:
            self._read = parse(self._file.read_text("utf-8").splitlines())
        except OSError as error:
            self._read = ()
            _log.error("the keys file cannot be read: it lets nobody in", reason=error.strerror)
        except ValueError as error:
            # UnicodeDecodeError is one of them, and quotes what it could not decode.
            reason = "it is not UTF-8" if isinstance(error, UnicodeError) else str(error)
            _log.error("the keys file is broken: keys stay as they were", reason=reason)
        else:
            log = _log.info if self._read else _log.error
            log("keys read", keys=len(self._read))


def _stamp(file: Path) -> object:
    """Return what changes when a file does, also where it is replaced within one tick."""
    try:
        status = file.stat()
    except OSError as error:
        return error.errno
    return status.st_mtime_ns, status.st_size, status.st_ino


def _token(headers: Mapping[str, str]) -> str:
    scheme, _, token = headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return token.strip()
    return headers.get("x-api-key", "").strip()
