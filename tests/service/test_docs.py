# SPDX-License-Identifier: Apache-2.0
"""The page of the API works without the internet."""

import re
import shutil
import socket
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import uvicorn
from starlette.testclient import TestClient

from pugeo_service.app import create_app
from pugeo_service.settings import Settings

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.fixture
def client(tmp_path: Path) -> TestClient:
    """A service whose engine is not started."""
    return TestClient(create_app(Settings(engine="inline", spool_dir=tmp_path)))


def test_everything_it_loads_is_here(client: TestClient) -> None:
    """Each script and style is served by the service, with its type, and may be cached."""
    page = client.get("/docs")
    assert page.headers["content-type"].startswith("text/html")
    loaded = re.findall(r'(?:src|href)="([^"]+)"', page.text)
    assert "docs/swagger-ui-bundle.js" in loaded
    for address in loaded:
        if address != "data:,":
            answer = client.get(f"/{address}")
            assert answer.status_code == 200, address
            kind = {"js": "text/javascript", "css": "text/css", "json": "application/json"}
            assert answer.headers["content-type"].startswith(kind[address.rsplit(".")[-1]])
            if address.startswith("docs/"):
                assert "max-age" in answer.headers["cache-control"]
    assert "://" not in page.text
    assert "://" not in client.get("/docs/start.js").text


def test_its_policy_lets_nothing_else_in(client: TestClient) -> None:
    """The policy allows only scripts of the service and no frames."""
    policy = client.get("/docs").headers["content-security-policy"]
    assert "script-src 'self';" in policy
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'none'" in policy
    assert "http" not in policy
    assert "unsafe" not in policy


def test_what_is_not_there(client: TestClient) -> None:
    """Only the files of the page are served."""
    for name in ("nothing.js", "LICENSE", "../docs.py", "%2e%2e%2fdocs.py"):
        assert client.get(f"/docs/{name}").status_code == 404


@pytest.fixture
def address(tmp_path: Path) -> Iterator[str]:
    """Address of the service on a real port."""
    app = create_app(Settings(engine="inline", spool_dir=tmp_path))
    server = uvicorn.Server(uvicorn.Config(app, lifespan="off", log_config=None))
    listener = socket.create_server(("127.0.0.1", 0))
    thread = threading.Thread(target=server.run, args=([listener],))
    thread.start()
    yield f"http://127.0.0.1:{listener.getsockname()[1]}"
    server.should_exit = True
    thread.join(20)
    listener.close()


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
def test_a_browser_shows_it(address: str, tmp_path: Path) -> None:
    """Chromium without a network shows all operations and reports no error."""
    assert CHROMIUM is not None
    command = [
        CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
        "--disable-component-update", "--disable-sync", "--disable-quic", "--no-first-run",
        "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1", "--enable-logging=stderr",
        f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=20000", "--dump-dom",
        f"{address}/docs",
    ]  # fmt: skip
    shown = subprocess.run(command, capture_output=True, text=True, check=True, timeout=100)
    assert 'id="operations-upsample-upsample"' in shown.stdout
    assert "Authorize" in shown.stdout
    assert not re.findall(r"CONSOLE.*", shown.stderr)
