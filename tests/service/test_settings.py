# SPDX-License-Identifier: Apache-2.0
"""Settings come from the environment or the command line, and wrong ones are refused."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from pugeo_service import settings as module
from pugeo_service.server import main
from pugeo_service.settings import Settings, explain, unknown_names


def test_the_environment_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """``PUGEO_`` and the name of a field sets it."""
    monkeypatch.setenv("PUGEO_PORT", "0")
    monkeypatch.setenv("PUGEO_WORKERS", "3")
    settings = Settings()
    assert (settings.port, settings.worker_count) == (0, 3)


def test_arguments_win(monkeypatch: pytest.MonkeyPatch) -> None:
    """Arguments have priority over the environment."""
    monkeypatch.setenv("PUGEO_PORT", "1234")
    assert Settings(port=4321).port == 4321


def test_two_workers_at_least(monkeypatch: pytest.MonkeyPatch) -> None:
    """On one processor there are two workers."""
    monkeypatch.setattr(module, "available_cpus", lambda: 1)
    assert Settings(workers=0).worker_count == 2


def test_one_worker_if_asked_for() -> None:
    """An explicit number of workers is used."""
    assert Settings(workers=1).worker_count == 1


@pytest.mark.parametrize("address", ["tcp://scheduler:8786", "scheduler:8786", "ws://x:1"])
def test_an_open_scheduler_is_refused(address: str) -> None:
    """A scheduler without TLS is refused, because it executes any code it receives."""
    with pytest.raises(ValidationError, match="tls://"):
        Settings(scheduler=address)


def test_a_scheduler_needs_credentials(tmp_path: Path) -> None:
    """The error names every missing file."""
    (tmp_path / "ca.pem").touch()
    with pytest.raises(ValidationError, match="PUGEO_TLS_CERT, PUGEO_TLS_KEY"):
        Settings(scheduler="tls://scheduler:8786", tls_ca=tmp_path / "ca.pem")


def test_a_spool_folder_must_exist(tmp_path: Path) -> None:
    """A missing folder is an error at the start."""
    with pytest.raises(ValidationError, match="not a folder"):
        Settings(spool_dir=tmp_path / "missing")


SECONDS = ["deadline_s", "body_idle_s", "jobs_ttl_s", "jobs_deadline_s", "drain_delay_s", "drain_s"]


@pytest.mark.parametrize("name", SECONDS)
@pytest.mark.parametrize("value", ["inf", "nan", "-1", "1e300", "soon"])
def test_seconds_are_finite(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    """No number of seconds is infinite, NaN, negative or longer than ten years."""
    (line,) = refused(monkeypatch, name, value)
    assert line.startswith(f"PUGEO_{name.upper()}={value}: ")


@pytest.mark.parametrize(
    "value", ["", "0.001", "100MB", "700 MiB", "abc", "-1GB", "nan", "1.5", "0"]
)
def test_a_worker_has_memory_for_the_model(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    """Memory in which no worker could start is refused, with the values that are allowed."""
    (line,) = refused(monkeypatch, "worker_memory", value)
    assert line.startswith(f"PUGEO_WORKER_MEMORY={value}: must be auto, bytes such as 2GB")


@pytest.mark.parametrize("value", ["auto", "2GB", "1.5 GiB", "2000000000", "1.0", "1"])
def test_memory_that_suffices(value: str) -> None:
    """Sizes, shares and ``auto`` are taken as they are."""
    assert Settings(worker_memory=value).worker_memory == value


@pytest.mark.parametrize(
    "value",
    [
        "",
        "mysql://a:hush@host/name",
        "postgresql://a:hush@host:port/name",
        "postgresql://a:hush@[::1",
    ],
)
def test_a_password_is_not_repeated(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    """A wrong address of a database is refused without its text, which may hold a password."""
    (line,) = refused(monkeypatch, "database_url", value)
    assert line.startswith("PUGEO_DATABASE_URL=...: must be postgresql://")
    assert "hush" not in line


def test_a_key_is_not_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wrong entry of a key is refused without its text, which may be the key itself."""
    (line,) = refused(monkeypatch, "api_keys", "pugeo_hush")
    assert line.startswith("PUGEO_API_KEYS=...: entry 1 is not NAME:SHA256")


@pytest.mark.parametrize("name", ["spool_dir", "jobs_dir", "tls_ca", "tls_cert", "tls_key"])
def test_an_empty_path_is_not_the_current_folder(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """An empty path is refused."""
    (line,) = refused(monkeypatch, name, "")
    assert line.startswith(f"PUGEO_{name.upper()}=: names no file or folder")


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="there is no /proc")
def test_a_spool_folder_takes_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder in which no file can be made is refused."""
    (line,) = refused(monkeypatch, "spool_dir", "/proc")
    assert line.startswith("PUGEO_SPOOL_DIR=/proc: no file can be made")


def test_certificates_are_read(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, root: Path) -> None:
    """Files that are missing, or no certificates, are refused by name; a good set is taken."""
    files = {
        name: tmp_path / "made" / f"{name[4:]}.pem" for name in ("tls_ca", "tls_cert", "tls_key")
    }
    monkeypatch.setenv("PUGEO_SCHEDULER", "tls://scheduler:8786")
    for name, path in files.items():
        monkeypatch.setenv(f"PUGEO_{name.upper()}", str(path))
    assert [line.partition("=")[0] for line in lines()] == [
        "PUGEO_TLS_CA", "PUGEO_TLS_CERT", "PUGEO_TLS_KEY",
    ]  # fmt: skip
    command = [sys.executable, str(root / "deploy/make_certs.py"), str(tmp_path / "made")]
    subprocess.run(command, check=True)
    assert Settings().tls_ca == files["tls_ca"]
    good = files["tls_key"].read_bytes()
    for name in ("tls_key", "tls_ca"):
        files[name].write_bytes(b"no certificate")
        (line,) = lines()
        assert f"PUGEO_{name.upper()}={files[name]}" in line
        files[name].write_bytes(good)


@pytest.mark.parametrize("name", ["jobs_attempts", "jobs_queue", "queue_requests", "max_points"])
@pytest.mark.parametrize("value", ["0", "-1", "abc", "", "1.5", str(1 << 63)])
def test_counts_are_positive_and_fit_a_database(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str
) -> None:
    """A count is a whole number from 1, of no more bits than a database has."""
    (line,) = refused(monkeypatch, name, value)
    assert line.startswith(f"PUGEO_{name.upper()}={value}: should be ")


@pytest.mark.parametrize("host", ["127.0.0.1", "::", "fe80::1%eth0", "localhost", "a-b.example."])
def test_hosts_that_are_taken(host: str) -> None:
    """Addresses and names are taken as they are."""
    assert Settings(host=host).host == host
    written = f"[{host}]" if ":" in host else host
    taken = f"tls://{written}:8786"
    assert Settings._encrypted(taken) == taken


@pytest.mark.parametrize(
    "host", ["", "a b", "http://127.0.0.1", "127.0.0.1:80", "[::1]", "a" * 64, "a..b", "-a", "ä"]
)
def test_what_is_no_host(monkeypatch: pytest.MonkeyPatch, host: str) -> None:
    """Everything else is refused, with what is allowed."""
    (line,) = refused(monkeypatch, "host", host)
    assert line.startswith(f"PUGEO_HOST={host}: must be an address or name of this machine")


@pytest.mark.parametrize(
    "address",
    [
        "tls://", "tls://host", "tls://host:", "tls://a:b@host:1", "tls://host:65536",
        "tls://a b:1", "tls://[host:1", "tls://[]:1", "tls://[host]:1", "tls://::1:1",
    ],
)  # fmt: skip
def test_a_scheduler_has_host_and_port(monkeypatch: pytest.MonkeyPatch, address: str) -> None:
    """An address without host or port is refused."""
    (line,) = refused(monkeypatch, "scheduler", address)
    assert line == f"PUGEO_SCHEDULER={address}: must be tls://host:port"


def test_ports_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    """Metrics cannot have the port of the service."""
    monkeypatch.setenv("PUGEO_PORT", "9100")
    (line,) = refused(monkeypatch, "metrics_port", "9100")
    assert line == "PUGEO_METRICS_PORT=9100 must differ from PUGEO_PORT"


def test_mistyped_names_are_found() -> None:
    """A name that no part reads is reported with a similar one; others are left alone."""
    names = ["PUGEO_WORKER", "pugeo_port", "PUGEO_URL", "PUGEO_TEST_X", "HOME", "PUGEO_ZZZZZZZZ"]
    assert unknown_names(names) == {"PUGEO_WORKER": "PUGEO_WORKERS", "PUGEO_ZZZZZZZZ": None}


def refused(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> list[str]:
    """The lines about a setting of the environment that is refused."""
    monkeypatch.setenv(f"PUGEO_{name.upper()}", value)
    return lines()


def lines() -> list[str]:
    """The lines about settings of the environment that are refused."""
    with pytest.raises(ValidationError) as caught:
        Settings()
    return list(explain(caught.value))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"workers": -1}, "PUGEO_WORKERS=-1: "),
        ({"scheduler": "tcp://somewhere:8786"}, "tls://"),
        ({"spool_dir": "/nowhere"}, "not a folder"),
    ],
)
def test_the_command_tells_a_wrong_setting_in_a_line(
    capsys: pytest.CaptureFixture[str], given: dict[str, Any], words: str
) -> None:
    """`pugeo serve` with a wrong option ends with status 2 and a line on stderr, nothing more."""
    assert main(given) == 2
    printed = capsys.readouterr()
    (line,) = printed.err.splitlines()
    assert words in line
    assert printed.out == ""
