# SPDX-License-Identifier: Apache-2.0
"""The proxy of the profile "tls", with its real configuration on other ports."""

import contextlib
import datetime as dt
import shutil
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import httpx2
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from tests.free_port import free_port

TRAEFIK = shutil.which("traefik", path=str(Path(sys.executable).parent)) or shutil.which("traefik")
CONNECTIONS, REQUESTS = 6, 3
START_S = 60.0

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(TRAEFIK is None, reason="make test-deploy installs traefik"),
]


class Upstream(BaseHTTPRequestHandler):
    """Answers with the headers of the request; ``/held`` waits until the gate is open."""

    protocol_version = "HTTP/1.1"
    gate = threading.Event()
    busy = False  # it answers requests, and no probe

    def do_GET(self) -> None:
        if self.path == "/health/live" and self.busy:
            self.send_error(503)
            return
        if self.path == "/held":
            self.gate.wait(START_S)
        body = str(self.headers).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Stay quiet."""


@dataclass(frozen=True)
class Proxy:
    """A running proxy: its ports, its configuration, and the certificate that it must show."""

    http: int
    https: int
    configuration: Path
    certificate: Path

    def client(self, trusting: bool = False) -> httpx2.Client:
        """Return a client that trusts nothing but the certificate, or everything."""
        context: ssl.SSLContext | bool = not trusting
        if not trusting:
            context = ssl.create_default_context(cafile=str(self.certificate))
        return httpx2.Client(base_url=f"https://localhost:{self.https}", verify=context, timeout=30)


def write_certificate(folder: Path) -> Path:
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "localhost")])
    now = dt.datetime.now(dt.UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - dt.timedelta(minutes=5))
        .not_valid_after(now + dt.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    pem = serialization.Encoding.PEM
    form = serialization.PrivateFormat.PKCS8
    (folder / "key.pem").write_bytes(key.private_bytes(pem, form, serialization.NoEncryption()))
    (folder / "cert.pem").write_bytes(certificate.public_bytes(pem))
    return folder / "cert.pem"


class Busy(Upstream):
    """One whose probes fail, as they do by the time limit of the proxy under load."""

    busy = True
    server_version = "Busy"


@contextlib.contextmanager
def upstream(kind: type[Upstream] = Upstream) -> Iterator[int]:
    """A service on a port of its own."""
    with ThreadingHTTPServer(("127.0.0.1", 0), kind) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server.server_port
        finally:
            Upstream.gate.set()
            server.shutdown()
            thread.join()


@contextlib.contextmanager
def running(files: Path, folder: Path, **environment: str) -> Iterator[Proxy]:
    """The proxy; only ports, folders and the authority differ from the committed files."""
    ports = {number: free_port() for number in (8080, 8082, 8443, 8444)}
    certificate = write_certificate(folder)
    for name in ("traefik.yml", "routes.yml"):
        text = (files / name).read_text("utf-8")
        for number, port in ports.items():
            text = text.replace(f":{number}", f":{port}")
        for path in ("/etc/traefik", "/certificates", "/acme/"):
            text = text.replace(f" {path}", f" {folder}" + "/" * path.endswith("/"))
        text = text.replace("interval: 5s, timeout: 3s", "interval: 100ms, timeout: 100ms")
        nobody = f"caServer: http://127.0.0.1:{free_port()}"
        text = text.replace("      httpChallenge:", f"      {nobody}\n      httpChallenge:")
        (folder / name).write_text(text, "utf-8")
    given = {
        "PUGEO_CONNECTIONS_PER_ADDRESS": str(CONNECTIONS),
        "PUGEO_REQUESTS_PER_ADDRESS": str(REQUESTS),
    }
    command = [str(TRAEFIK), f"--configfile={folder}/traefik.yml"]
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(command, env=given | environment, stdout=log, stderr=log)
        try:
            proxy = Proxy(ports[8080], ports[8443], folder / "traefik.yml", certificate)
            wait_until(lambda: answers(proxy), folder / "log")
            yield proxy
        finally:
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def proxy(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Proxy]:
    """The proxy in front of one upstream, with a certificate from a folder."""
    folder = tmp_path_factory.mktemp("proxy")
    with (
        upstream() as port,
        running(root / "deploy/proxy", folder, PUGEO_UPSTREAMS=f"http://127.0.0.1:{port}") as found,
    ):
        told = (folder / "log").read_text("utf-8")
        assert '"level":"error"' not in told, told
        yield found


def answers(proxy: Proxy) -> bool:
    with proxy.client(trusting=True) as client:
        try:
            return bool(client.get("/").status_code == 200)
        except httpx2.HTTPError:
            return False


def wait_until(true: Callable[[], bool], log: Path | None = None) -> None:
    end = time.monotonic() + START_S
    while not true():
        if time.monotonic() > end:
            pytest.fail(f"not within {START_S} s: {log.read_text('utf-8') if log else ''}")
        time.sleep(0.05)


def test_it_shows_our_certificate_and_tells_the_address(proxy: Proxy) -> None:
    """TLS ends at the proxy; the service learns the address of the client from the proxy alone."""
    with proxy.client() as client:
        told = client.get("/", headers={"X-Forwarded-For": "10.9.8.7"}).text
    assert "X-Forwarded-For: 127.0.0.1" in told
    assert "10.9.8.7" not in told
    assert "X-Forwarded-Proto: https" in told


def test_its_health_check(proxy: Proxy) -> None:
    """The command of the container's health check succeeds while the proxy runs."""
    command = [str(TRAEFIK), "healthcheck", f"--configfile={proxy.configuration}"]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_large_bodies_pass(proxy: Proxy) -> None:
    """A body of 30 MB comes back byte for byte."""
    body = bytes(range(256)) * 120_000
    with proxy.client() as client:
        assert client.post("/", content=body).content == body


def test_plain_http_is_sent_to_https(proxy: Proxy) -> None:
    """Port 80 redirects to https for good, on the port that the host publishes."""
    answer = httpx2.get(f"http://localhost:{proxy.http}/jobs?limit=1")
    assert answer.status_code in {301, 308}
    assert answer.headers["location"] in {
        "https://localhost/jobs?limit=1",
        "https://localhost:443/jobs?limit=1",
    }


def test_connections_of_an_address_are_bounded(proxy: Proxy) -> None:
    """Idle connections beyond the bound are closed at once, and there is room when some end."""
    context = ssl.create_default_context(cafile=str(proxy.certificate))

    def opened() -> ssl.SSLSocket | None:
        plain = socket.create_connection(("127.0.0.1", proxy.https), 30)
        try:
            return context.wrap_socket(plain, server_hostname="localhost")
        except OSError:
            plain.close()
            return None

    wait_until(lambda: answers(proxy))
    sockets = [opened() for _ in range(CONNECTIONS + 4)]
    held = [each for each in sockets if each is not None]
    try:
        assert len(held) == CONNECTIONS
        assert sockets[-1] is None
    finally:
        for each in held:
            each.close()
    wait_until(lambda: answers(proxy))


def test_requests_of_an_address_are_bounded(proxy: Proxy) -> None:
    """A request beyond the bound is refused with 429 while the others are under way."""
    statuses: list[int] = []

    def ask() -> None:
        with proxy.client() as client:
            statuses.append(client.get("/held").status_code)

    threads = [threading.Thread(target=ask) for _ in range(REQUESTS + 1)]
    for thread in threads:
        thread.start()
    wait_until(lambda: len(statuses) == 1)
    assert statuses == [429]
    Upstream.gate.set()
    for thread in threads:
        thread.join()
    assert sorted(statuses) == [200] * REQUESTS + [429]


def test_a_front_that_is_gone_costs_no_request(root: Path, tmp_path: Path) -> None:
    """Of two fronts one refuses connections: every request is answered by the other."""
    with upstream() as port:
        upstreams = f"http://127.0.0.1:{free_port()},http://127.0.0.1:{port}"
        files = root / "deploy/proxy"
        with (
            running(files, tmp_path, PUGEO_UPSTREAMS=upstreams) as proxy,
            proxy.client() as client,
        ):
            statuses = [client.post("/", content=b"cloud").status_code for _ in range(20)]
    assert statuses == [200] * 20


def test_a_front_that_is_alone_stays(root: Path, tmp_path: Path) -> None:
    """One that has no time for probes gets its requests: nobody else could take them."""
    with (
        upstream(Busy) as port,
        running(root / "deploy/proxy", tmp_path, PUGEO_UPSTREAMS=f"http://127.0.0.1:{port}") as it,
        it.client() as client,
    ):
        for _ in range(20):  # many times the interval of probes here
            assert client.get("/").status_code == 200
            time.sleep(0.1)


def test_of_several_fronts_a_busy_one_is_left_out(root: Path, tmp_path: Path) -> None:
    """One whose probes fail gets no more requests while another one answers its own."""
    with upstream(Busy) as busy, upstream() as port:
        upstreams = f"http://127.0.0.1:{busy},http://127.0.0.1:{port}"
        with (
            running(root / "deploy/proxy", tmp_path, PUGEO_UPSTREAMS=upstreams) as proxy,
            proxy.client() as client,
        ):

            def left_out() -> bool:
                return all("Busy" not in client.get("/").headers["Server"] for _ in range(20))

            wait_until(left_out, tmp_path / "log")


def test_a_public_name_alone_is_served(root: Path, tmp_path: Path) -> None:
    """With PUGEO_DOMAIN an authority is asked for a certificate, and other names are not found."""
    with upstream() as port:
        given = {"PUGEO_UPSTREAMS": f"http://127.0.0.1:{port}", "PUGEO_DOMAIN": "localhost"}
        with (
            running(root / "deploy/proxy", tmp_path, **given) as proxy,
            proxy.client(trusting=True) as client,
        ):
            assert client.get("/").status_code == 200
            assert client.get("/", headers={"Host": "pugeo.example"}).status_code == 404
            told = tmp_path / "log"
            wait_until(lambda: "Unable to obtain ACME certificate" in told.read_text("utf-8"), told)
