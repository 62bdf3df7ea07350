# SPDX-License-Identifier: Apache-2.0
"""docker-compose.yml and the image's Dockerfile agree with the service."""

import json
import os
import re
import socket
import ssl
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
import yaml

from pugeo_service.settings import Settings, unknown_names


@pytest.fixture
def services(root: Path) -> dict[str, Any]:
    """The services of docker-compose.yml by name."""
    loaded: dict[str, Any] = yaml.safe_load((root / "docker-compose.yml").read_text("utf-8"))
    found: dict[str, Any] = loaded["services"]
    return found


def test_containers_set_what_the_service_knows(root: Path, services: dict[str, Any]) -> None:
    """Every PUGEO_ variable that reaches a container of ours is a setting of the service."""
    known = {f"PUGEO_{name.upper()}" for name in Settings.model_fields}
    used = set(re.findall(r"(PUGEO_\w+)=\S", (root / "Dockerfile").read_text("utf-8")))
    for service in services.values():
        if service["image"].startswith("pugeo"):
            used |= {name for name in service.get("environment", {}) if name.startswith("PUGEO_")}
    assert len(used) > 5
    assert used <= known


def test_no_variable_of_compose_is_taken_for_a_mistake(root: Path) -> None:
    """The variables of .env.example, exported, cause no warning of an unknown setting."""
    text = (root / ".env.example").read_text("utf-8")
    assert unknown_names(re.findall(r"^#?(\w+)=", text, re.MULTILINE)) == {}


def test_the_example_environment_is_complete(root: Path) -> None:
    """.env.example lists exactly the variables of docker-compose.yml, with their defaults."""
    text = (root / "docker-compose.yml").read_text("utf-8")
    asked = dict(re.findall(r"\$\{(\w+):-([^}]*)\}", text))
    shown = dict(re.findall(r"^(\w+)=(.*)$", (root / ".env.example").read_text(), re.MULTILINE))
    assert shown == asked


def test_containers_are_locked_down(services: dict[str, Any]) -> None:
    """Containers have no capability but those that are named, and are published to this host."""
    granted = {"proxy": 1, "postgres": 5}
    for name, service in services.items():
        assert service["cap_drop"] == ["ALL"], name
        assert len(service.get("cap_add", ())) == granted.get(name, 0), name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        assert all("127.0.0.1" in port for port in service.get("ports", [])), name
        if str(service["image"]).startswith("pugeo"):
            assert service["read_only"] is True, name
            assert service["init"] is True, name


def test_secrets_are_passed_on_and_never_empty(services: dict[str, Any]) -> None:
    """Secrets are passed on without a default, because an empty value is refused."""
    optional = (
        "API_KEYS", "DATABASE_URL", "CORS_ORIGINS", "MODELS_DIR", "CANARY", "JOBS_STORE",
        "WEBHOOK_SECRET",
    )  # fmt: skip
    for front in ("api", "front"):
        for name in (*(f"PUGEO_{each}" for each in optional), "OTEL_EXPORTER_OTLP_ENDPOINT"):
            assert services[front]["environment"][name] is None


def test_every_setting_reaches_the_service(root: Path, services: dict[str, Any]) -> None:
    """Each setting reaches the services from `.env`, but those of the image or of the role."""
    image = set(re.findall(r"(PUGEO_\w+)=\S", (root / "Dockerfile").read_text("utf-8")))
    known = {f"PUGEO_{name.upper()}" for name in Settings.model_fields}
    api = set(services["api"]["environment"])
    assert known - api == image - {"PUGEO_LOG_FORMAT"}
    # The workers of `front` are in containers of their own.
    assert api - set(services["front"]["environment"]) == {"PUGEO_WORKERS", "PUGEO_ENGINE"}
    of_workers = {f"PUGEO_{name}" for name in ("WORKERS", "WORKER_MEMORY", "MODEL", "START_S")}
    assert of_workers <= services["worker"]["environment"].keys()
    for role in ("api", "front", "scheduler", "worker"):
        for name in ("PUGEO_LOG_FORMAT", "PUGEO_LOG_LEVEL"):
            assert services[role]["environment"][name].startswith(f"${{{name}:-"), (role, name)


def test_what_the_example_offers_is_passed_on(root: Path, services: dict[str, Any]) -> None:
    """The names that .env.example shows as comments are those that services pass on."""
    text = (root / ".env.example").read_text("utf-8")
    offered = set(re.findall(r"^#(\w+)=", text, re.MULTILINE))
    passed = {
        name
        for service in services.values()
        for name, value in service.get("environment", {}).items()
        if value is None
    }
    assert offered == passed
    assert {"AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_ENDPOINT_URL"} <= passed


def test_folders_of_the_image_can_be_written(root: Path, services: dict[str, Any]) -> None:
    """Each role has a volume where the image puts what it writes, since its root is read-only."""
    folder = re.search(r"PUGEO_SPOOL_DIR=(\S+)", (root / "Dockerfile").read_text("utf-8"))
    assert folder is not None
    ours = [name for name, each in services.items() if each["image"].startswith("pugeo")]
    assert {"api", "front", "scheduler", "worker"} <= set(ours)
    for name in ours:
        mounts = [mount.split(":") for mount in services[name]["volumes"]]
        assert [m[2:] for m in mounts if m[1] == folder[1]] == [[]], name


def test_no_variable_of_the_image_is_taken_away(root: Path, services: dict[str, Any]) -> None:
    """A name without a value that .env does not set is unset, also where the image sets it."""
    fixed = set(re.findall(r"(\w+)=\S", (root / "Dockerfile").read_text("utf-8")))
    assert "PUGEO_JOBS_DIR" in fixed
    for name, service in services.items():
        if service["image"].startswith("pugeo"):
            given = service.get("environment", {})
            assert not {key for key, value in given.items() if value is None} & fixed, name


def test_fronts_and_workers_have_the_same_weights(services: dict[str, Any]) -> None:
    """The default model comes from the same variable in each role."""
    for name in ("api", "front", "worker"):
        environment = services[name]["environment"]
        assert "PUGEO_MODEL" in environment, name
        assert environment["PUGEO_MODEL"] is None, name


def test_profiles_start_what_they_need(services: dict[str, Any]) -> None:
    """Services that another one waits for are started with it, or may be missing."""
    for name, service in services.items():
        profiles = set(service.get("profiles", ()))
        needs = service.get("depends_on", {})
        for other in needs:
            optional = isinstance(needs, dict) and needs[other].get("required") is False
            theirs = set(services[other].get("profiles", ()))
            assert optional or not theirs or profiles <= theirs, (name, other)


def test_fronts_share_the_folder_of_their_jobs(services: dict[str, Any]) -> None:
    """Each front sees the same folder and the same database, which jobs need."""
    assert "front-jobs:/var/lib/pugeo" in services["front"]["volumes"]
    assert services["front"]["deploy"]["replicas"] == "${PUGEO_FRONTS:-1}"


def test_the_health_check_of_the_image(root: Path) -> None:
    """The command that the image runs succeeds where the port answers 200, and only there."""
    text = (root / "Dockerfile").read_text("utf-8").replace("\\\n", " ")
    found = re.search(r"^HEALTHCHECK .*? CMD (\[.*\])$", text, re.MULTILINE)
    assert found is not None
    command = [sys.executable, *json.loads(found[1])[1:]]
    asked = []

    class Live(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_response(200 if len(asked) == 1 else 503)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Live) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        environment = os.environ | {"PUGEO_PORT": str(server.server_port)}
        codes = [
            subprocess.run(command, env=environment, check=False, capture_output=True).returncode
            for _ in range(2)
        ]
        server.shutdown()
        thread.join()
    assert (codes, asked) == ([0, 1], ["/health/live"] * 2)


def test_the_certificates_are_good_for_both_ends(root: Path, tmp_path: Path) -> None:
    """Two ends that hold the folder's files trust each other over TLS, and nobody else's."""
    for folder in ("ours", "theirs"):
        command = [sys.executable, str(root / "deploy/make_certs.py"), str(tmp_path / folder)]
        subprocess.run(command, check=True)
    assert (tmp_path / "ours/key.pem").stat().st_mode & 0o077 == 0

    def context(folder: str, side: int) -> ssl.SSLContext:
        made = ssl.SSLContext(side)
        made.check_hostname = False
        made.verify_mode = ssl.CERT_REQUIRED
        made.load_verify_locations(tmp_path / folder / "ca.pem")
        made.load_cert_chain(tmp_path / folder / "cert.pem", tmp_path / folder / "key.pem")
        return made

    def meet(folder: str) -> bytes:
        near, far = socket.socketpair()
        client = context(folder, ssl.PROTOCOL_TLS_CLIENT)

        def greet() -> None:
            try:
                with client.wrap_socket(near) as wrapped:
                    wrapped.sendall(b"hello")
            except ssl.SSLError:
                near.close()

        thread = threading.Thread(target=greet)
        thread.start()
        try:
            with context("ours", ssl.PROTOCOL_TLS_SERVER).wrap_socket(far, True) as wrapped:
                return wrapped.recv(5)
        finally:
            thread.join()

    assert meet("ours") == b"hello"
    with pytest.raises(ssl.SSLError):
        meet("theirs")


def test_the_cluster_runs_our_commands(services: dict[str, Any]) -> None:
    """Scheduler and workers are started by `pugeo`, over the certificates of the front."""
    assert services["scheduler"]["command"][:2] == ["pugeo", "scheduler"]
    assert services["worker"]["command"] == ["pugeo", "worker"]
    for name in ("scheduler", "worker", "front"):
        environment = services[name]["environment"]
        files = [environment[f"PUGEO_TLS_{part}"] for part in ("CA", "CERT", "KEY")]
        assert files == [f"/certificates/{part}.pem" for part in ("ca", "cert", "key")]
    assert services["worker"]["environment"]["PUGEO_SCHEDULER"] == "tls://scheduler:8786"
