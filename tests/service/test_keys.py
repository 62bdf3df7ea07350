# SPDX-License-Identifier: Apache-2.0
"""API keys: hashes, headers, and rotation by file."""

import hashlib
import hmac
import os
import subprocess
import sys
from pathlib import Path

import pytest
from pydantic import ValidationError
from starlette.requests import Request

from pugeo_service.keys import Entry, Keys, hash_of, new_token, owner_of, parse
from pugeo_service.settings import Settings

PUGEO = str(Path(sys.executable).parent / "pugeo")


def entry(name: str, token: str) -> str:
    """A line of the file."""
    return f"{name}:{hashlib.sha256(token.encode()).hexdigest()}"


def bearer(token: str) -> dict[str, str]:
    """Headers with a token."""
    return {"authorization": f"Bearer {token}"}


def test_both_headers_and_the_owner() -> None:
    """Both headers work, in any case of the scheme, and give the owner."""
    keys = Keys(None, parse([entry("ann", "secret-a"), entry("bob", "secret-b")]))
    assert keys.required
    assert keys.owner(bearer("secret-a")) == "ann"
    assert keys.owner({"authorization": "bearer  secret-b"}) == "bob"
    assert keys.owner({"x-api-key": "secret-b"}) == "bob"


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"authorization": "Bearer "},
        {"authorization": "Bearer secret-A"},
        {"authorization": "Basic secret-a"},
        {"authorization": "secret-a"},
        {"x-api-key": ""},
        {"x-api-key": hashlib.sha256(b"secret-a").hexdigest()},
        {"x-api-key": "sch\udcff\xf6n"},
    ],
)
def test_what_does_not_open(headers: dict[str, str]) -> None:
    """No key, a wrong one, another scheme, and the hash of a key are refused."""
    assert Keys(None, parse([entry("ann", "secret-a")])).owner(headers) is None


def test_the_empty_token_is_never_a_key() -> None:
    """The empty token is refused even if its hash is an entry."""
    keys = Keys(None, parse([entry("nobody", "")]))
    assert keys.owner({}) is None
    assert keys.owner(bearer("")) is None


def test_every_entry_is_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    """All keys are compared in constant time, so the time reveals nothing."""
    entries = parse([entry(name, name) for name in "abcd"])
    keys = Keys(None, entries)
    seen: list[str] = []
    real = hmac.compare_digest

    def counting(one: str, other: str) -> bool:
        seen.append(one)
        return real(one, other)

    monkeypatch.setattr(hmac, "compare_digest", counting)
    assert keys.owner(bearer("a")) == "a"
    assert seen == [one.digest for one in entries]


def write(path: Path, text: str, stamp: int) -> None:
    """Write a file with a given modification time."""
    path.write_text(text)
    os.utime(path, ns=(stamp, stamp))


def test_rotation(tmp_path: Path) -> None:
    """Added keys are valid at once, removed ones invalid; several may have one name."""
    path = tmp_path / "keys"
    write(path, f"# our keys\n\n{entry('ann', 'old')}\n", 1)
    keys = Keys(path, None)
    assert keys.owner(bearer("old")) == "ann"
    write(path, f"{entry('ann', 'old')}\n{entry('ann', 'new')}\n", 2)
    assert [keys.owner(bearer(token)) for token in ("old", "new")] == ["ann", "ann"]
    write(path, f"{entry('ann', 'new')}\n", 3)
    assert [keys.owner(bearer(token)) for token in ("old", "new")] == [None, "ann"]


def test_a_file_replaced_within_a_tick(tmp_path: Path) -> None:
    """A file replaced by one of the same size and time is read again."""
    path = tmp_path / "keys"
    write(path, entry("ann", "one"), 5)
    keys = Keys(path, None)
    write(tmp_path / "next", entry("ann", "two"), 5)
    (tmp_path / "next").replace(path)
    assert [keys.owner(bearer(token)) for token in ("one", "two")] == [None, "ann"]


@pytest.mark.parametrize(
    "broken", ["ann", "ann:secret", f"a b:{'0' * 64}", f"ann:{'0' * 63}", f"ann:{'A' * 64}"]
)
def test_a_broken_file_changes_nothing(tmp_path: Path, broken: str) -> None:
    """The previous keys stay valid; the error gives the number of the line but not its text."""
    path = tmp_path / "keys"
    write(path, entry("ann", "good"), 1)
    keys = Keys(path, None)
    write(path, f"{entry('bob', 'other')}\n{broken}\n", 2)
    assert keys.owner(bearer("good")) == "ann"
    assert keys.owner(bearer("other")) is None
    with pytest.raises(ValueError, match="entry 2") as caught:
        parse(path.read_text().splitlines())
    assert broken not in str(caught.value)


def test_bytes_that_are_no_text(tmp_path: Path) -> None:
    """A file that is not UTF-8 is malformed."""
    path = tmp_path / "keys"
    write(path, entry("ann", "good"), 1)
    keys = Keys(path, None)
    path.write_bytes(b"\xff\xfe" + bytes(300))
    assert keys.owner(bearer("good")) == "ann"


@pytest.mark.parametrize("state", ["missing", "empty", "comments", "folder", "broken"])
def test_no_keys_let_nobody_in(tmp_path: Path, state: str) -> None:
    """A key file without a valid key refuses all requests."""
    path = tmp_path / "keys"
    if state == "folder":
        path.mkdir()
    elif state != "missing":
        path.write_text({"empty": "", "comments": "# none yet\n", "broken": "ann\n"}[state])
    keys = Keys(path, None)
    assert keys.required
    assert keys.owner(bearer("anything")) is None
    assert keys.owner({}) is None


def test_a_file_that_goes_away(tmp_path: Path) -> None:
    """The keys of a deleted file are invalid until it is back."""
    path = tmp_path / "keys"
    write(path, entry("ann", "good"), 1)
    keys = Keys(path, None)
    path.unlink()
    assert keys.owner(bearer("good")) is None
    write(path, entry("ann", "good"), 2)
    assert keys.owner(bearer("good")) == "ann"


def test_file_and_settings_add_up(tmp_path: Path) -> None:
    """Keys of both are valid."""
    path = tmp_path / "keys"
    path.write_text(entry("ann", "one"))
    keys = Keys(path, parse([entry("bob", "two")]))
    assert [keys.owner(bearer(token)) for token in ("one", "two")] == ["ann", "bob"]


def test_without_settings_nothing_is_asked_for() -> None:
    """Without settings no key is required, and requests have no owner."""
    assert not Keys(None, None).required
    assert owner_of(Request({"type": "http", "headers": []})) == ""
    assert owner_of(Request({"type": "http", "headers": [], "state": {"owner": "ann"}})) == "ann"


def test_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Entries are separated by commas; the error for a malformed one does not quote it."""
    line = entry("ann", "a")
    monkeypatch.setenv("PUGEO_API_KEYS", f"{line}, {entry('bob', 'b')}")
    settings = Settings()
    assert settings.api_keys is not None
    assert str(settings.api_keys[0]) == line
    assert len(settings.api_keys) == 2
    monkeypatch.setenv("PUGEO_API_KEYS", "ann:my-secret-token")
    with pytest.raises(ValidationError) as caught:
        Settings()
    assert "my-secret-token" not in caught.value.errors()[0]["msg"]


@pytest.mark.parametrize("name", ["PUGEO_API_KEYS", "PUGEO_API_KEYS_FILE"])
def test_an_empty_setting_is_refused(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """An empty setting is refused, because it may be a missing secret."""
    monkeypatch.setenv(name, "")
    with pytest.raises(ValidationError, match="unset it"):
        Settings()


def test_tokens_are_long_and_differ() -> None:
    """Tokens have 256 random bits after a fixed prefix."""
    one, two = new_token(), new_token()
    assert one != two
    assert one.startswith("pugeo_")
    assert len(one) == len("pugeo_") + 43


def test_the_command(tmp_path: Path) -> None:
    """`pugeo keys new` prints the entry to stdout and the key to stderr."""
    made = subprocess.run([PUGEO, "keys", "new", "ann"], capture_output=True, text=True, check=True)
    token = made.stderr.split()[-1]
    assert made.stdout == f"{Entry('ann', hash_of(token))}\n"
    assert token not in made.stdout
    path = tmp_path / "keys"
    path.write_text(made.stdout)
    assert Keys(path, None).owner(bearer(token)) == "ann"
    wrong = subprocess.run(
        [PUGEO, "keys", "new", "a b"], capture_output=True, text=True, check=False
    )
    assert (wrong.returncode, wrong.stdout) == (2, "")
