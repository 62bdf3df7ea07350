# SPDX-License-Identifier: Apache-2.0
"""Settings of connections: address, proxy, certificates, and processes."""

import asyncio
import datetime as dt
import os
import socket
import ssl
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx2
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from pugeo_client import AsyncClient, Client
from pugeo_client.errors import ConfigurationError, ConnectionFailedError, PugeoError

ClientRunner = Callable[..., Any]


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("localhost:8000", "must look like http://127.0.0.1:8000"),
        ("ftp://host", "must look like"),
        ("http://", "must look like"),
        ("/path", "must look like"),
        ("http://[::1", "port"),
        ("http://host:port", "port"),
        ("http://a..b", "label"),
        ("http://" + "a" * 70, "label"),
        ("http://\0", "non-printable"),
    ],
)
@pytest.mark.parametrize("kind", [Client, AsyncClient])
def test_unusable_addresses(kind: type, url: str, words: str) -> None:
    """An address that no request could reach is refused when the client is made."""
    with pytest.raises(ConfigurationError, match=words):
        kind(url)


def test_a_trailing_slash_is_removed() -> None:
    """An address is kept without its last slash."""
    with Client("http://near:2/base/") as client:
        assert client.base_url == "http://near:2/base"
        assert (client.timeout, client.max_retries) == (600.0, 3)


@pytest.mark.parametrize(
    "settings",
    [
        {"HTTP_PROXY": "nonsense://proxy:1"},
        {"HTTPS_PROXY": "http://user:se-cret@:port"},
        {"ALL_PROXY": "socks5://user:se-cret@proxy:1"},
        {"SSL_CERT_FILE": "/nowhere/ca.pem"},
    ],
)
@pytest.mark.parametrize("kind", [Client, AsyncClient])
def test_unusable_proxies_and_certificates(
    monkeypatch: pytest.MonkeyPatch, kind: type, settings: dict[str, str]
) -> None:
    """A setting of the environment that the HTTP library refuses is a ConfigurationError."""
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ConfigurationError, match="check the proxies in HTTP_PROXY") as caught:
        kind("http://host")
    assert "se-cret" not in str(caught.value)


def test_a_proxy_that_is_not_there(
    run_client: ClientRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A refused proxy is a connection failure; the password of the address is not shown."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    monkeypatch.setenv("HTTP_PROXY", f"http://user:se-cret@127.0.0.1:{port}")
    monkeypatch.delenv("NO_PROXY", raising=False)
    monkeypatch.delenv("no_proxy", raising=False)
    with pytest.raises(ConnectionFailedError) as caught:
        run_client(
            lambda client: client.health(), base_url="http://me:se-cret@service.example/base"
        )
    assert "http://service.example/base" in str(caught.value)
    assert "se-cret" not in str(caught.value)


@pytest.fixture
def tls(tmp_path: Path) -> ssl.SSLContext:
    """A context of a server whose certificate nobody has signed."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "localhost")])
    now = dt.datetime.now(dt.UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - dt.timedelta(days=1))
        .not_valid_after(now + dt.timedelta(days=1))
        .sign(key, hashes.SHA256())
    )
    pem = tmp_path / "server.pem"
    pem.write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
        + certificate.public_bytes(serialization.Encoding.PEM)
    )
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(pem)
    return context


def test_a_certificate_that_is_not_trusted(
    run_client: Any, serve: Any, tls: ssl.SSLContext
) -> None:
    """It is a ConfigurationError that names the way out, without retries."""

    def script(connection: socket.socket, _: int) -> None:
        try:
            tls.wrap_socket(connection, server_side=True).close()
        except OSError:
            return

    with serve(script) as url, pytest.raises(ConfigurationError, match="SSL_CERT_FILE"):
        run_client(lambda client: client.health(), base_url=url.replace("http:", "https:"))
    assert run_client.waits == []


def test_a_slow_header_over_tls(serve: Any, tls: ssl.SSLContext) -> None:
    """The deadline holds on encrypted connections too."""
    left_early = threading.Event()

    def script(connection: socket.socket, _: int) -> None:
        with tls.wrap_socket(connection, server_side=True) as encrypted:
            encrypted.recv(65536)
            pause = threading.Event()
            try:
                for _ in range(200):
                    encrypted.sendall(b"H")
                    pause.wait(0.05)
            except OSError:
                left_early.set()

    trusting = ssl.create_default_context()
    trusting.check_hostname = False
    trusting.verify_mode = ssl.CERT_NONE
    with (
        serve(script) as url,
        httpx2.Client(verify=trusting) as http,
        Client(url.replace("http:", "https:"), http_client=http, timeout=0.5) as client,
        pytest.raises(PugeoError, match=r"0\.5 s"),
    ):
        client.health()
    assert left_early.wait(30)


def numbered(connection: socket.socket, number: int) -> None:
    """Answer each request with the number of its connection."""
    while connection.recv(65536):
        body = f'{{"connection": {number}}}'.encode()
        connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n" % len(body) + body)


def in_a_fork(call: Callable[[], str]) -> str:
    """Return what a forked child makes of a call."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.write(writer, call().encode())
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "r") as file:
        said = file.read()
    os.waitpid(child, 0)
    return said


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_child_has_its_own_connection(serve: Any) -> None:
    """Parent and child never share a socket, on which each would read answers of the other."""
    with serve(numbered) as url, Client(url) as client:
        assert client.health() == client.health() == {"connection": 0}
        assert in_a_fork(lambda: str(client.health())) == "{'connection': 1}"
        assert client.health() == {"connection": 0}


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_given_client_is_not_shared_with_a_child(serve: Any) -> None:
    """A child cannot renew an HTTP client that was given: it is told to make its own."""

    def attempt() -> str:
        try:
            return str(client.health())
        except ConfigurationError as error:
            return str(error)

    with serve(numbered) as url, httpx2.Client() as http, Client(url, http_client=http) as client:
        assert in_a_fork(attempt) == "{'connection': 0}"  # nothing was shared yet
        assert client.health() == {"connection": 1}
        assert "make a Client in each process" in in_a_fork(attempt)


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_child_of_an_asyncio_program(serve: Any) -> None:
    """The asyncio client renews its connections in a child too."""
    client: list[AsyncClient] = []

    async def parent(url: str) -> dict[str, Any]:
        client.append(AsyncClient(url))
        return await client[0].health()

    with serve(numbered) as url:
        loop = asyncio.new_event_loop()
        assert loop.run_until_complete(parent(url)) == {"connection": 0}
        said = in_a_fork(lambda: str(asyncio.run(client[0].health())))
        assert said == "{'connection': 1}"
        assert loop.run_until_complete(client[0].health()) == {"connection": 0}
        loop.run_until_complete(client[0].aclose())
        loop.close()


def test_a_timeout_that_is_no_number(run_client: ClientRunner) -> None:
    """NaN, which no comparison would ever end, is refused; infinity is allowed."""
    with pytest.raises(ConfigurationError, match="NaN"):
        run_client(lambda client: client.upsample(b"", timeout=float("nan")))
    report = run_client(
        lambda client: client.health(),
        lambda _: httpx2.Response(200, json={}),
        timeout=float("inf"),
    )
    assert report == {}
