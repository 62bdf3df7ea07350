# SPDX-License-Identifier: Apache-2.0
"""Alerts, dashboard and scrape configuration fit the metrics that the service has."""

import contextlib
import json
import re
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise
from pathlib import Path
from typing import Any

import httpx2
import pytest
import yaml
from tests.free_port import free_port
from tests.http_client import HTTP

from pugeo_service.observability.telemetry import Readings, Telemetry, WorkerUse

PROMTOOL, PROMETHEUS = shutil.which("promtool"), shutil.which("prometheus")
needs_promtool = pytest.mark.skipif(
    PROMTOOL is None, reason="there is no promtool (apt-get install prometheus)"
)
ROWS = ["Queue", "Requests and stages", "Points a second", "Errors", "Workers", "Memory", "Jobs"]
ALERTS_TEST = "tests/deploy/alerts_test.yml"


def loaded(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load(path.read_text("utf-8"))
    return found


def rules(root: Path) -> list[dict[str, Any]]:
    (group,) = loaded(root / "deploy/prometheus/alerts.yml")["groups"]
    found: list[dict[str, Any]] = group["rules"]
    return found


def panels(root: Path) -> list[dict[str, Any]]:
    text = (root / "deploy/grafana/dashboards/pugeo.json").read_text("utf-8")
    found: list[dict[str, Any]] = json.loads(text)["panels"]
    return found


def expressions(root: Path) -> list[str]:
    """Every expression of a panel, for all fronts."""
    asked = [target["expr"] for panel in panels(root) for target in panel.get("targets", ())]
    return [expression.replace("$front", ".*") for expression in asked]


def promtool(*arguments: str | Path) -> str:
    assert PROMTOOL is not None
    command = [PROMTOOL, *map(str, arguments)]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_prometheus_asks_every_front(root: Path) -> None:
    """The scraped names are all services with metrics, at the port that no host publishes."""
    services = loaded(root / "docker-compose.yml")["services"]
    fronts = {name: each for name, each in services.items() if "PUGEO_METRICS_PORT" in str(each)}
    (scrape,) = loaded(root / "deploy/prometheus/prometheus.yml")["scrape_configs"]
    (found,) = scrape["dns_sd_configs"]
    assert set(found["names"]) == set(fronts) == {"api", "front"}
    for service in fronts.values():
        assert service["environment"]["PUGEO_METRICS_PORT"] == str(found["port"])
        assert not any(str(found["port"]) in published for published in service["ports"])


def test_every_metric_that_is_named_is_served(root: Path) -> None:
    """Panels, alerts and the tests of alerts use only existing metrics."""
    readings = Readings(0, 0, 0, 0, 0, 0, uses=(WorkerUse("0", 1, 1, 0.0),))
    telemetry = Telemetry(lambda: readings, "1")
    told = {"process_open_fds", "process_max_fds"}  # Linux alone tells them
    suffixes = {"counter": ["_total"], "histogram": ["_bucket", "_sum", "_count"]}
    for metric in telemetry.registry.collect():
        told |= {metric.name + suffix for suffix in suffixes.get(metric.type, [""])}
    texts = [*expressions(root), *(rule["expr"] for rule in rules(root))]
    texts.append((root / ALERTS_TEST).read_text("utf-8"))
    named = {name for text in texts for name in re.findall(r"\b(?:pugeo|process)_\w+", text)}
    assert len(named) > 25
    assert named <= told


def test_the_dashboard_has_its_rows(root: Path) -> None:
    """Rows stand in their order, none is empty, and panels neither overlap nor leave gaps."""
    found = panels(root)
    assert [panel["title"] for panel in found if panel["type"] == "row"] == ROWS
    assert found[0]["type"] == "row"
    kinds = [panel["type"] for panel in found]
    assert ("row", "row") not in set(pairwise(kinds))
    assert kinds[-1] != "row"
    assert len({panel["id"] for panel in found}) == len(found)
    taken: set[tuple[int, int]] = set()
    for panel in found:
        at = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(at["x"], at["x"] + at["w"])
            for y in range(at["y"], at["y"] + at["h"])
        }
        assert not taken & cells
        taken |= cells
    assert len(taken) == 24 * max(y + 1 for _, y in taken)


@needs_promtool
def test_every_panel_is_valid_promql(root: Path, tmp_path: Path) -> None:
    """Prometheus' own parser accepts the expression of each panel."""
    recorded = [
        {"record": f"panel:{number}", "expr": expression}
        for number, expression in enumerate(expressions(root))
    ]
    assert len(recorded) > 25
    path = tmp_path / "panels.yml"
    path.write_text(yaml.safe_dump({"groups": [{"name": "panels", "rules": recorded}]}), "utf-8")
    assert f"{len(recorded)} rules found" in promtool("check", "rules", path)


@needs_promtool
def test_the_configuration_is_valid(root: Path) -> None:
    """Prometheus' own checker accepts the configuration and its rules."""
    promtool("check", "config", root / "deploy/prometheus/prometheus.yml")


@needs_promtool
def test_each_alert_fires_once(root: Path) -> None:
    """Each alert fires on its own input, and none does while the service works."""
    tests = loaded(root / ALERTS_TEST)["tests"]
    names = [rule["alert"] for rule in rules(root)]
    quiet = {each["alertname"] for each in tests[0]["alert_rule_test"]}
    fired = {
        each["alertname"]
        for test in tests[1:]
        for each in test["alert_rule_test"]
        if each.get("exp_alerts")
    }
    assert quiet == fired == set(names)
    promtool("test", "rules", root / ALERTS_TEST)


def test_each_alert_is_explained(root: Path) -> None:
    """The page of operations has a section for each alert, in the order of the file."""
    text = (root / "docs/how-to/operations.md").read_text("utf-8")
    found = re.findall(r"^### (Pugeo\w+)\n\n(.+)", text, re.MULTILINE)
    assert [name for name, _ in found] == [rule["alert"] for rule in rules(root)]


class Metrics(BaseHTTPRequestHandler):
    """Answers as a front does, with one metric."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/plain; version=0.0.4")
        self.end_headers()
        self.wfile.write(b"# TYPE pugeo_queue_patches gauge\npugeo_queue_patches 42\n")

    def log_message(self, *_: object) -> None:
        """Stay quiet."""


@pytest.fixture
def opened() -> Iterator[contextlib.ExitStack]:
    with contextlib.ExitStack() as stack:
        yield stack


def start(opened: contextlib.ExitStack, command: list[str], log: Path, **extra: Any) -> None:
    """Run a program until the end of the test."""
    stream = opened.enter_context(log.open("wb"))
    process = subprocess.Popen(command, stdout=stream, stderr=stream, **extra)
    opened.callback(process.wait)
    opened.callback(process.kill)


def wait_until(true: Callable[[], bool], told: Path, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while True:
        with contextlib.suppress(httpx2.HTTPError):
            if true():
                return
        if time.monotonic() > end:
            pytest.fail(told.read_text("utf-8"))
        time.sleep(0.1)


@pytest.mark.slow
@pytest.mark.skipif(PROMETHEUS is None, reason="there is no prometheus (apt-get install it)")
@pytest.mark.parametrize("sent", [True, False])
def test_metrics_are_sent_on_where_a_url_is_set(
    root: Path,
    tmp_path: Path,
    opened: contextlib.ExitStack,
    sent: bool,
) -> None:
    """`start.sh` starts Prometheus; a second one gets its metrics, if a URL names it."""
    assert PROMETHEUS is not None
    front = opened.enter_context(ThreadingHTTPServer(("127.0.0.1", 0), Metrics))
    opened.callback(front.shutdown)
    threading.Thread(target=front.serve_forever).start()
    theirs, ours = free_port(), free_port()
    logs = {name: tmp_path / f"{name}.log" for name in ("theirs", "ours")}
    (tmp_path / "empty.yml").write_text("global: {}\n", "utf-8")
    start(
        opened,
        [
            PROMETHEUS,
            f"--config.file={tmp_path}/empty.yml",
            f"--storage.tsdb.path={tmp_path}/theirs",
            f"--web.listen-address=127.0.0.1:{theirs}",
            "--web.enable-remote-write-receiver",
        ],
        logs["theirs"],
    )
    folder = tmp_path / "deploy"
    shutil.copytree(root / "deploy/prometheus", folder)
    path = folder / "prometheus.yml"
    text = path.read_text("utf-8").replace("10s\n  eval", "1s\n  eval")
    path.write_text(
        re.sub(r"    # The service.*", "", text, flags=re.DOTALL)
        + (f"    static_configs:\n      - targets: ['127.0.0.1:{front.server_port}']\n"),
        "utf-8",
    )
    (tmp_path / "ours").mkdir()
    url = f"http://127.0.0.1:{theirs}/api/v1/write?it='s"
    environment = {
        "PATH": str(Path(PROMETHEUS).parent) + ":/usr/bin:/bin",
        "PROMETHEUS_DATA": str(tmp_path / "ours"),
        "PUGEO_REMOTE_WRITE_URL": url if sent else "",
        "PUGEO_REMOTE_WRITE_USER": "o'hara" if sent else "",
        "PUGEO_REMOTE_WRITE_PASSWORD": "secret",
    }
    command = ["/bin/sh", str(folder / "start.sh"), f"--web.listen-address=127.0.0.1:{ours}"]
    start(opened, command, logs["ours"], env=environment)

    def value(port: int) -> list[str]:
        query = f"http://127.0.0.1:{port}/api/v1/query?query=pugeo_queue_patches"
        answer = HTTP.get(query)
        # Prometheus answers before it has read its data.
        found = answer.json()["data"]["result"] if answer.status_code == 200 else []
        return [each["value"][1] for each in found]

    wait_until(lambda: value(ours) == ["42"], logs["ours"])
    written = tmp_path / "ours/prometheus.yml"
    assert written.stat().st_mode & 0o077 == 0
    promtool("check", "config", written)
    if sent:
        wait_until(lambda: value(theirs) == ["42"], logs["ours"])
        (target,) = loaded(written)["remote_write"]
        assert target["url"] == url
        assert target["basic_auth"] == {"username": "o'hara", "password": "secret"}
    else:
        assert "remote_write" not in loaded(written)
