# SPDX-License-Identifier: Apache-2.0
"""The init container of the chart's pods, whose command is run on this machine."""

import os
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

helm = pytest.importorskip("helm_python", reason="make test-deploy installs Helm's library")

KERNEL = "pugeo_model/neighbours.py312.nbi"


@pytest.fixture
def volumes() -> Iterator[Path]:
    """A folder that every user may enter, unlike pytest's own."""
    with tempfile.TemporaryDirectory(prefix="pugeo-volumes-") as folder:
        Path(folder).chmod(0o755)
        yield Path(folder)


@pytest.fixture(params=["worker", "front"])
def pod(root: Path, request: pytest.FixtureRequest) -> dict[str, Any]:
    """The pod of a component that has such a container."""
    with helm.Chart.load(root / "deploy/chart") as chart:
        files = chart.render({}, name="pugeo")
    deployment = next(yaml.safe_load_all(files[f"pugeo/templates/{request.param}.yaml"]))
    found: dict[str, Any] = deployment["spec"]["template"]["spec"]
    return found


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder to another user")
def test_kernels_are_copied_into_a_folder_of_root(pod: dict[str, Any], volumes: Path) -> None:
    """The pod's user copies the kernels into an empty volume, again too, and may write there."""
    (container,) = pod["initContainers"]
    rights = pod["securityContext"]
    user, group = rights["runAsUser"], rights["runAsGroup"]
    image, volume = volumes / "image", volumes / "kernels"
    (image / KERNEL).parent.mkdir(parents=True)
    (image / KERNEL).write_bytes(b"kernel")
    for each in (image, *image.rglob("*")):
        os.chown(each, user, group)
    # As the kubelet makes an emptyDir of a pod with fsGroup.
    volume.mkdir()
    os.chown(volume, 0, rights["fsGroup"])
    volume.chmod(0o2777)
    command = [
        word.replace("/var/cache/pugeo", str(image)).replace("/kernels", str(volume))
        for word in container["command"]
    ]

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            words, user=user, group=group, extra_groups=[rights["fsGroup"]],
            check=False, capture_output=True, text=True,
        )  # fmt: skip

    for _ in range(2):  # the second time as after a restart of the container
        done = run(*command)
        assert (done.returncode, done.stderr) == (0, "")
    assert (volume / KERNEL).read_bytes() == b"kernel"
    assert run("touch", str((volume / KERNEL).with_suffix(".new"))).returncode == 0
