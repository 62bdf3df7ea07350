# SPDX-License-Identifier: Apache-2.0
"""deploy/ and docker-compose.yml agree with the service."""

import re
from pathlib import Path
from typing import Any

import yaml
from starlette.testclient import TestClient

from pugeo_service.app import create_app
from pugeo_service.settings import Settings


def loaded(path: Path) -> dict[str, Any]:
    """A YAML file."""
    found: dict[str, Any] = yaml.safe_load(path.read_text("utf-8"))
    return found


def test_prometheus_asks_where_the_metrics_are(root: Path) -> None:
    """The scraped port is the port of metrics of the named container."""
    services = loaded(root / "docker-compose.yml")["services"]
    (scrape,) = loaded(root / "deploy/prometheus/prometheus.yml")["scrape_configs"]
    for target in scrape["static_configs"][0]["targets"]:
        name, _, port = target.partition(":")
        assert services[name]["environment"]["PUGEO_METRICS_PORT"] == port
        # The port is internal, because metrics there need no key.
        assert not any(str(port) in published for published in services[name]["ports"])


def test_every_metric_that_is_named_is_served(root: Path, tmp_path: Path) -> None:
    """Panels, alerts and rules use only existing metrics."""
    text = (
        TestClient(create_app(Settings(engine="inline", spool_dir=tmp_path))).get("/metrics").text
    )
    told: set[str] = set()
    suffixes = {"counter": [""], "histogram": ["_bucket", "_sum", "_count"], "gauge": [""]}
    for name, kind in re.findall(r"^# TYPE (\w+) (\w+)$", text, re.MULTILINE):
        told |= {name + suffix for suffix in suffixes[kind]}
    named = {
        name
        for path in (root / "deploy").rglob("*")
        if path.suffix in {".json", ".yml"}
        for name in re.findall(r"\bpugeo_\w+", path.read_text("utf-8"))
    }
    assert len(named) > 15
    assert named <= told


def test_secrets_are_passed_on_and_never_empty(root: Path) -> None:
    """Secrets are passed on without a default, because an empty value is refused."""
    environment = loaded(root / "docker-compose.yml")["services"]["api"]["environment"]
    for name in ("PUGEO_API_KEYS", "PUGEO_CORS_ORIGINS", "OTEL_EXPORTER_OTLP_ENDPOINT"):
        assert name in environment
        assert environment[name] is None


def test_the_cluster_runs_our_commands(root: Path) -> None:
    """Scheduler and workers are started by `pugeo`, over the certificates of the front."""
    services = loaded(root / "docker-compose.yml")["services"]
    assert services["scheduler"]["command"][:2] == ["pugeo", "scheduler"]
    assert services["worker"]["command"] == ["pugeo", "worker"]
    for name in ("scheduler", "worker", "front"):
        environment = services[name]["environment"]
        files = [environment[f"PUGEO_TLS_{part}"] for part in ("CA", "CERT", "KEY")]
        assert files == [f"/certificates/{part}.pem" for part in ("ca", "cert", "key")]
    assert services["worker"]["environment"]["PUGEO_SCHEDULER"] == "tls://scheduler:8786"
