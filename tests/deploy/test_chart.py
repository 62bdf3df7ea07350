# SPDX-License-Identifier: Apache-2.0
"""The Helm chart: linted, rendered without a cluster, and compared with Kubernetes' schemas."""

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from pugeo_service.settings import Settings

helm = pytest.importorskip("helm_python", reason="make test-deploy installs Helm's library")
kubernetes_validate = pytest.importorskip(
    "kubernetes_validate", reason="make test-deploy installs the schemas"
)

OLDEST, NEWEST = "1.29", kubernetes_validate.latest_version()
MODEL = "pugeo.example:5000/pugeo"
DIGEST = "0" * 64
EVERYTHING: dict[str, Any] = {
    "image": {"repository": MODEL, "tag": "1", "pullSecrets": [{"name": "registry"}]},
    "settings": {"PUGEO_MAX_POINTS": "100", "OTEL_EXPORTER_OTLP_ENDPOINT": "http://collector:4318"},
    "secretSettings": {"PUGEO_WEBHOOK_SECRET": {"name": "webhooks", "key": "secret"}},
    "models": {"existingClaim": "weights"},
    "keys": {"entries": [f"ann:{DIGEST}"]},
    "tls": {"existingSecret": "our-certificates"},
    "database": {"existingSecret": "our-database"},
    "jobs": {"persistence": {"accessMode": "ReadWriteMany", "storageClass": "nfs"}},
    "front": {"replicas": 3, "nodeSelector": {"zone": "a"}, "tolerations": [{"key": "x"}]},
    "worker": {"affinity": {"nodeAffinity": {}}},
    "autoscaling": {"enabled": True},
    "ingress": {"enabled": True, "host": "pugeo.example", "tlsSecret": "tls", "className": "nginx"},
    "networkPolicy": {
        "clients": [{"namespaceSelector": {"matchLabels": {"name": "ingress"}}}],
        "monitoring": [{"namespaceSelector": {"matchLabels": {"name": "monitoring"}}}],
        "egress": [{"ports": [{"port": 4318}]}],
    },
    "serviceMonitor": {"enabled": True, "labels": {"release": "prometheus"}},
    "prometheusRule": {"enabled": True},
}
Manifest = dict[str, Any]


@pytest.fixture(scope="module")
def chart(root: Path) -> Iterator[Any]:
    with helm.Chart.load(root / "deploy/chart") as loaded:
        yield loaded


def render(chart: Any, values: dict[str, Any], name: str = "scans") -> list[Manifest]:
    """Every manifest of a release; of the values, those that are given are checked as well."""
    chart.validate_schema(values)
    files = chart.render(values, name=name, namespace="pugeo")
    manifests = [
        manifest
        for path, text in files.items()
        if path.endswith(".yaml")
        for manifest in yaml.safe_load_all(text)
    ]
    return [manifest for manifest in manifests if manifest is not None]


def of(manifests: list[Manifest], kind: str) -> dict[str, Manifest]:
    """The manifests of a kind by name."""
    return {each["metadata"]["name"]: each for each in manifests if each["kind"] == kind}


def fits(selector: dict[str, str], labels: dict[str, str]) -> bool:
    return selector.items() <= labels.items()


@pytest.fixture(scope="module", params=["default", "everything"])
def manifests(request: pytest.FixtureRequest, chart: Any) -> list[Manifest]:
    return render(chart, {} if request.param == "default" else EVERYTHING)


@pytest.fixture(scope="module")
def everything(chart: Any) -> list[Manifest]:
    return render(chart, EVERYTHING)


@pytest.mark.parametrize("values", [{}, EVERYTHING], ids=["default", "everything"])
def test_helm_finds_nothing_to_complain_about(root: Path, values: dict[str, Any]) -> None:
    """`helm lint --strict` has neither an error nor a warning."""
    report = helm.lint(root / "deploy/chart", values, strict=True, kube_version=f"v{OLDEST}.0")
    assert report["total_charts_linted"] == 1
    assert report["errors"] == []
    assert [each for each in report["messages"] if each["severity"] > 1] == []


@pytest.mark.parametrize("version", [OLDEST, NEWEST])
def test_manifests_fit_the_schemas_of_kubernetes(manifests: list[Manifest], version: str) -> None:
    """Each manifest has exactly the fields that this version of Kubernetes has."""
    foreign = {"ServiceMonitor", "PrometheusRule"}
    checked = [each for each in manifests if each["kind"] not in foreign]
    assert len(checked) > 12
    for manifest in checked:
        kubernetes_validate.validate(manifest, version, strict=True)


def test_a_wrong_field_is_noticed(manifests: list[Manifest]) -> None:
    """The schema refuses a field that does not exist, so the test above can fail."""
    wrong = {**manifests[0], "speck": {}}
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(wrong, NEWEST, strict=True)


def test_containers_have_no_rights(manifests: list[Manifest]) -> None:
    """All containers: uid 10001, a read-only root, no capability, no token, bounds, probes."""
    deployments = of(manifests, "Deployment")
    assert set(deployments) == {f"scans-pugeo-{name}" for name in ("front", "scheduler", "worker")}
    for deployment in deployments.values():
        pod = deployment["spec"]["template"]["spec"]
        assert pod["automountServiceAccountToken"] is False
        assert pod["securityContext"]["runAsNonRoot"] is True
        assert pod["securityContext"]["runAsUser"] == 10001
        assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        for container in pod["containers"] + pod.get("initContainers", []):
            rights = container["securityContext"]
            assert rights["readOnlyRootFilesystem"] is True
            assert rights["allowPrivilegeEscalation"] is False
            assert rights["capabilities"] == {"drop": ["ALL"]}
            assert container["resources"]["limits"]["memory"]
            mounted = {each["name"] for each in container["volumeMounts"]}
            assert mounted <= {each["name"] for each in pod["volumes"]}
        for container in pod["containers"]:
            assert {"startupProbe", "livenessProbe", "readinessProbe"} <= container.keys()


def test_the_image_says_the_same(root: Path, manifests: list[Manifest]) -> None:
    """User, folders and ports of the pods are those of the image."""
    dockerfile = (root / "Dockerfile").read_text("utf-8")
    assert "USER 10001:10001" in dockerfile
    pod = of(manifests, "Deployment")["scans-pugeo-front"]["spec"]["template"]["spec"]
    mounted = {each["mountPath"] for each in pod["containers"][0]["volumeMounts"]}
    for folder in ("/var/cache/pugeo", "/var/lib/pugeo", "/var/spool/pugeo"):
        assert folder in dockerfile
        assert folder in mounted
    ports = {each["name"]: each["containerPort"] for each in pod["containers"][0]["ports"]}
    assert f"EXPOSE {ports['http']}" in dockerfile


def test_settings_are_those_of_the_service(manifests: list[Manifest]) -> None:
    """Names of the ConfigMap exist, values are allowed, and nothing in it is a secret."""
    data = of(manifests, "ConfigMap")["scans-pugeo-settings"]["data"]
    known = {f"PUGEO_{name.upper()}" for name in Settings.model_fields}
    assert {name for name in data if name.startswith("PUGEO_")} <= known
    assert not {"PUGEO_API_KEYS", "PUGEO_DATABASE_URL", "PUGEO_WEBHOOK_SECRET"} & data.keys()
    paths = {"tls_ca", "tls_cert", "tls_key", "api_keys_file", "scheduler", "models_dir"}
    given = {name.removeprefix("PUGEO_").lower(): value for name, value in data.items()}
    settings = Settings(**{name: value for name, value in given.items() if name not in paths})
    assert settings.metrics_port == 9100
    assert Settings._encrypted(data["PUGEO_SCHEDULER"]) == data["PUGEO_SCHEDULER"]
    assert data["PUGEO_SCHEDULER"].split("/")[-1].split(":")[0] in of(manifests, "Service")


def test_secret_settings_come_from_secrets(everything: list[Manifest]) -> None:
    """Each is an environment variable of the front that names its Secret; none is in the clear."""
    (front,) = of(everything, "Deployment")["scans-pugeo-front"]["spec"]["template"]["spec"][
        "containers"
    ]
    found = {each["name"]: each["valueFrom"]["secretKeyRef"] for each in front["env"]}
    assert found == {
        "PUGEO_DATABASE_URL": {"name": "our-database", "key": "url"},
        "PUGEO_WEBHOOK_SECRET": {"name": "webhooks", "key": "secret"},
    }


def test_weights_are_mounted(everything: list[Manifest]) -> None:
    """The folder of the setting is the claim, which the front cannot change."""
    data = of(everything, "ConfigMap")["scans-pugeo-settings"]["data"]
    pod = of(everything, "Deployment")["scans-pugeo-front"]["spec"]["template"]["spec"]
    (mount,) = [m for m in pod["containers"][0]["volumeMounts"] if m["name"] == "models"]
    (volume,) = [v for v in pod["volumes"] if v["name"] == "models"]
    assert mount == {"name": "models", "mountPath": data["PUGEO_MODELS_DIR"], "readOnly": True}
    assert volume["persistentVolumeClaim"] == {"claimName": "weights", "readOnly": True}


def test_fronts_with_a_store_share_no_volume(chart: Any) -> None:
    """With PUGEO_JOBS_STORE several fronts need no claim."""
    values = {
        "front": {"replicas": 2},
        "database": {"existingSecret": "db"},
        "secretSettings": {"PUGEO_JOBS_STORE": {"name": "store", "key": "url"}},
        "jobs": {"persistence": {"enabled": False}},
    }
    assert of(render(chart, values), "PersistentVolumeClaim") == {}


def test_services_find_their_pods(manifests: list[Manifest]) -> None:
    """Each selector fits the pods of one deployment, and each named port exists there."""
    pods = {name: each["spec"]["template"] for name, each in of(manifests, "Deployment").items()}
    wanted = {"": "front", "-metrics": "front", "-scheduler": "scheduler"}
    services = of(manifests, "Service")
    assert set(services) == {f"scans-pugeo{suffix}" for suffix in wanted}
    for suffix, component in wanted.items():
        spec = services[f"scans-pugeo{suffix}"]["spec"]
        found = [name for name, pod in pods.items() if fits(spec["selector"], labels(pod))]
        assert found == [f"scans-pugeo-{component}"]
        container = pods[found[0]]["spec"]["containers"][0]
        names = {port["name"] for port in container["ports"]}
        assert {port["targetPort"] for port in spec["ports"]} <= names
    for budget in of(manifests, "PodDisruptionBudget").values():
        selector = budget["spec"]["selector"]["matchLabels"]
        assert sum(fits(selector, labels(pod)) for pod in pods.values()) == 1


def labels(manifest: Manifest) -> dict[str, str]:
    found: dict[str, str] = manifest["metadata"]["labels"]
    return found


def allowed(manifests: list[Manifest], source: str, target: str) -> set[int]:
    """Ports of a component that the network policies let another component reach."""
    pods = {
        labels(each["spec"]["template"])["app.kubernetes.io/component"]: labels(
            each["spec"]["template"]
        )
        for each in of(manifests, "Deployment").values()
    }
    both: list[set[int]] = []
    for of_pod, peer, way, key in (
        (source, target, "egress", "to"),
        (target, source, "ingress", "from"),
    ):
        ports: set[int] = set()
        for policy in of(manifests, "NetworkPolicy").values():
            if not fits(policy["spec"]["podSelector"]["matchLabels"], pods[of_pod]):
                continue
            for rule in policy["spec"][way]:
                selectors = [each.get("podSelector", {}) for each in rule.get(key, [])]
                if any(fits(each.get("matchLabels", {"": ""}), pods[peer]) for each in selectors):
                    ports |= {each["port"] for each in rule["ports"]}
        both.append(ports)
    return both[0] & both[1]


def test_the_network_lets_through_what_is_needed(manifests: list[Manifest]) -> None:
    """Fronts, scheduler and workers reach each other as Dask needs it, and nothing else."""
    assert allowed(manifests, "front", "scheduler") == {8786}
    assert allowed(manifests, "front", "worker") == {8788}
    assert allowed(manifests, "worker", "scheduler") == {8786}
    assert allowed(manifests, "worker", "worker") == {8788}
    assert allowed(manifests, "scheduler", "worker") == {8788, 8789}
    assert allowed(manifests, "worker", "front") == set()
    assert allowed(manifests, "scheduler", "front") == set()
    command = of(manifests, "Deployment")["scans-pugeo-worker"]["spec"]["template"]["spec"][
        "containers"
    ][0]["command"]
    assert "--port=8788" in command


def test_a_database_may_be_reached(everything: list[Manifest]) -> None:
    """Fronts with a database may connect to it."""
    rules = of(everything, "NetworkPolicy")["scans-pugeo-front"]["spec"]["egress"]
    assert {"ports": [{"port": 5432}]} in rules
    assert {"ports": [{"port": 4318}]} in rules


def test_workers_follow_the_queue(everything: list[Manifest]) -> None:
    """The autoscaler asks for a metric that is served, and nobody else sets the replicas."""
    (scaler,) = of(everything, "HorizontalPodAutoscaler").values()
    worker = of(everything, "Deployment")[scaler["spec"]["scaleTargetRef"]["name"]]
    assert "replicas" not in worker["spec"]
    (metric,) = scaler["spec"]["metrics"]
    assert metric["external"]["metric"]["name"] == "pugeo_queue_patches"
    service = metric["external"]["metric"]["selector"]["matchLabels"]["service"]
    assert service in of(everything, "Service")


def test_prometheus_finds_metrics_and_alerts(root: Path, everything: list[Manifest]) -> None:
    """The monitor fits the service of metrics alone, and rules are those of deploy/prometheus."""
    (monitor,) = of(everything, "ServiceMonitor").values()
    selector = monitor["spec"]["selector"]["matchLabels"]
    found = [
        name for name, each in of(everything, "Service").items() if fits(selector, labels(each))
    ]
    assert found == ["scans-pugeo-metrics"]
    service = of(everything, "Service")[found[0]]
    assert labels(service)[monitor["spec"]["jobLabel"]] == "pugeo"
    (rule,) = of(everything, "PrometheusRule").values()
    alerts = yaml.safe_load((root / "deploy/prometheus/alerts.yml").read_text("utf-8"))
    assert rule["spec"] == alerts


def test_certificates_are_made_or_taken(chart: Any) -> None:
    """Without a Secret the chart makes certificates of one authority; with one it makes none."""
    data = of(render(chart, {}), "Secret")["scans-pugeo-tls"]["data"]
    assert set(data) == {"ca.pem", "cert.pem", "key.pem"}
    assert set(of(render(chart, EVERYTHING), "Secret")) == {"scans-pugeo-keys"}


def test_a_release_of_the_charts_name_is_short(chart: Any) -> None:
    """A release that is called pugeo does not repeat the name."""
    assert "pugeo-front" in of(render(chart, {}, name="pugeo"), "Deployment")


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"replicas": 3}, "replicas"),
        ({"front": {"replicas": 0}}, "replicas"),
        ({"front": {"readinessPath": "/"}}, "readinessPath"),
        ({"settings": {"MAX_POINTS": "1"}}, "MAX_POINTS"),
        ({"settings": {"PUGEO_MAX_POINTS": 1}}, "PUGEO_MAX_POINTS"),
        ({"keys": {"entries": ["ann:secret"]}}, "entries"),
        ({"worker": {"resources": {"limits": None}}}, "limits"),
        ({"jobs": {"persistence": {"accessMode": "ReadOnlyMany"}}}, "accessMode"),
    ],
)
def test_wrong_values_are_refused(chart: Any, values: dict[str, Any], named: str) -> None:
    """The schema of the values names the wrong one."""
    with pytest.raises(helm.HelmError, match=named):
        chart.validate_schema(values)


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"front": {"replicas": 2}}, r"database\.existingSecret"),
        (
            {"front": {"replicas": 2}, "database": {"existingSecret": "db"}},
            r"jobs\.persistence",
        ),
        (
            {
                "front": {"replicas": 2},
                "database": {"existingSecret": "db"},
                "settings": {"PUGEO_JOBS_STORE": "s3://jobs"},
            },
            r"jobs\.persistence\.enabled=false",
        ),
        ({"ingress": {"enabled": True}}, r"ingress\.host"),
        ({"settings": {"PUGEO_WEBHOOK_SECRET": "whsec_"}}, r"PUGEO_WEBHOOK_SECRET.*secretSettings"),
        ({"settings": {"PUGEO_WORKER_MEMORY": "2GB"}}, r"PUGEO_WORKER_MEMORY.*worker\.resources"),
    ],
)
def test_values_that_do_not_go_together(chart: Any, values: dict[str, Any], named: str) -> None:
    """A release that would not work is refused, with the value that is missing."""
    with pytest.raises(helm.HelmRenderError, match=named):
        render(chart, values)


def test_names_that_the_chart_sets_are_refused(
    root: Path, chart: Any, everything: list[Manifest]
) -> None:
    """A name of the ConfigMap, of a Secret or of the image cannot be set otherwise."""
    data = of(everything, "ConfigMap")["scans-pugeo-settings"]["data"]
    (front,) = of(everything, "Deployment")["scans-pugeo-front"]["spec"]["template"]["spec"][
        "containers"
    ]
    given = {*EVERYTHING["settings"], *EVERYTHING["secretSettings"]}
    set_here = {*data, *(each["name"] for each in front["env"])} - given
    image = re.findall(r"(PUGEO_\w+)=\S", (root / "Dockerfile").read_text("utf-8"))
    names = {*set_here, *image, "PUGEO_ENGINE", "PUGEO_WORKERS"} - {"PUGEO_LOG_FORMAT"}
    assert len(names) > 14
    for name in sorted(names):
        for where, value in (("settings", "1"), ("secretSettings", {"name": "a", "key": "b"})):
            with pytest.raises(helm.HelmRenderError, match=rf"{where}\.{name} cannot be set"):
                render(chart, {where: {name: value}})


def test_versions_agree(root: Path, chart: Any) -> None:
    """The chart is that of the project's version, and old enough Kubernetes is allowed."""
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    metadata = yaml.safe_load((root / "deploy/chart/Chart.yaml").read_text("utf-8"))
    assert metadata["appVersion"] == metadata["version"] == chart.version == project["version"]
    assert re.match(rf">={re.escape(OLDEST)}\.", metadata["kubeVersion"])
