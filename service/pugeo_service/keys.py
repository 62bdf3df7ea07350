# SPDX-License-Identifier: Apache-2.0
"""API keys and their owners.

A key has 256 random bits, so it can be found neither by guessing nor from its hash. Plain SHA-256
is therefore sufficient: slow hashes (argon2, bcrypt) protect passwords that people choose, and
would only slow each request down. The service stores hashes only, so a leaked key file opens
nothing.
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
# Names appear in logs and identify owners in the queue.
_ENTRY = re.compile(r"(?P<name>[A-Za-z0-9._-]{1,64}):(?P<digest>[0-9a-f]{64})")
_PREFIX = "pugeo_"


class _HasScope(Protocol):
    scope: Any


def owner_of(request: _HasScope) -> str:
    """Return the name of the key of a request; ``""`` if the service has no keys."""
    return str(request.scope.get("state", {}).get("owner", ""))


def new_token() -> str:
    """Make a token: a prefix for scanners of leaked secrets, and 256 random bits."""
    return _PREFIX + secrets.token_urlsafe(32)


def hash_of(token: str) -> str:
    """Return the SHA-256 of a token in hexadecimal."""
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).hexdigest()


@dataclass(frozen=True)
class Entry:
    """One valid key.

    Attributes:
        name: its owner. Several keys may have one name, for example during a rotation.
        digest: SHA-256 of the token, hexadecimal.
    """

    name: str
    digest: str

    def __str__(self) -> str:
        return f"{self.name}:{self.digest}"


def parse(lines: Iterable[str]) -> tuple[Entry, ...]:
    """Read entries ``name:sha256``; empty lines and comments (``#``) are skipped.

    Raises:
        ValueError: an entry has another form. The message gives its number but not its text, which
            may be a token entered by mistake.
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
    """All valid keys.

    The file is read again when it changes, so keys are added and removed without a restart. A
    missing or empty file contains no valid key; after a malformed one the previous keys stay valid.

    Args:
        file: file of entries, or ``None``.
        fixed: entries of the settings, or ``None``. If both are ``None``, no key is required.
    """

    def __init__(self, file: Path | None, fixed: tuple[Entry, ...] | None) -> None:
        self.required = file is not None or fixed is not None
        self._file = file
        self._fixed = fixed or ()
        self._read: tuple[Entry, ...] = ()
        self._stamp: object = ()
        self._refresh()

    def owner(self, headers: Mapping[str, str]) -> str | None:
        """Return the owner of the key in the headers of a request, or ``None``."""
        self._refresh()
        token = _token(headers)
        given = hash_of(token)
        found = None
        # All are compared, so that the time does not reveal which one matched.
        for entry in (*self._fixed, *self._read):
            if hmac.compare_digest(entry.digest, given):
                found = entry.name
        return found if token else None

    def version(self) -> object:
        """Return a value that is another one after the keys have changed."""
        self._refresh()
        return self._stamp

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
            _log.error("key file cannot be read; all keys in it are refused", reason=error.strerror)
        except ValueError as error:
            # UnicodeDecodeError is a ValueError, and its text quotes the file.
            reason = "it is not UTF-8" if isinstance(error, UnicodeError) else str(error)
            _log.error("key file is malformed; the previous keys stay valid", reason=reason)
        else:
            log = _log.info if self._read else _log.error
            log("key file read", keys=len(self._read))


def _stamp(file: Path) -> object:
    """Return a value that changes with the file, even if it is replaced within one clock tick."""
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
