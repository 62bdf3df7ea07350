# SPDX-License-Identifier: Apache-2.0
"""The table of attributes: what each format keeps, the same by command line, REST and SDK.

Clouds of one attribute each are written in a format, go through a route at R = 1, which moves no
point, and are read again.
"""

import io
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx2
import numpy as np
import pytest
import uvicorn
from numpy.typing import NDArray
from tests.http_client import HTTP

from pugeo_client import Client
from pugeo_model.cli.local import run_here
from pugeo_model.cli.tasks import Task, TaskSettings
from pugeo_model.cloud import Cloud, SourceInfo
from pugeo_model.formats import WRITABLE, dropped, read, write
from pugeo_service.app import create_app
from pugeo_service.settings import Settings

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "formats.md"
BEGIN, END = "<!-- attributes: begin -->\n", "<!-- attributes: end -->\n"
COUNT = 80
WKT = (
    'PROJCS["WGS 84 / UTM zone 32N",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,'
    '298.257223563]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],'
    'PROJECTION["Transverse_Mercator"],PARAMETER["latitude_of_origin",0],'
    'PARAMETER["central_meridian",9],PARAMETER["scale_factor",0.9996],'
    'PARAMETER["false_easting",500000],PARAMETER["false_northing",0],UNIT["metre",1],'
    'AUTHORITY["EPSG","32632"]]'
)


def _ball() -> NDArray[np.float64]:
    index = np.arange(COUNT) + 0.5
    height, angle = 1 - 2 * index / COUNT, index * np.pi * (3 - 5**0.5)
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)


NORMALS = _ball().astype(np.float32)
POINTS = np.round(10 * _ball() + [441_000.0, 4_475_000.0, 300.0], 6)
RNG = np.random.default_rng(0)
RGB = RNG.integers(0, 256, (COUNT, 3)).astype(np.uint8)
WIDE = RNG.integers(256, 65536, (COUNT, 3)).astype(np.uint16)
ALPHA = np.column_stack([RGB, RNG.integers(1, 255, COUNT).astype(np.uint8)])
REAL = RNG.random(COUNT).astype(np.float32)
INTENSITY = RNG.integers(256, 65536, COUNT).astype(np.uint16)
LABEL = (np.arange(COUNT) % 7).astype(np.uint8)
TIME = 300_000_000.0 + RNG.random(COUNT)


def _same(name: str, values: NDArray[np.generic]) -> Callable[[Cloud], bool]:
    def kept(cloud: Cloud) -> bool:
        # Text and JSON hold float32 as decimals, which are read as doubles.
        found = cloud.scalars.get(name)
        return found is not None and np.array_equal(found.astype(values.dtype), values)

    return kept


def _near(name: str, shares: NDArray[np.float64]) -> Callable[[Cloud], bool]:
    """Values that some formats scale to 0..1, as PTX demands."""

    def kept(cloud: Cloud) -> bool:
        found = cloud.scalars.get(name, np.zeros(COUNT)).astype(np.float64)
        scale = 65535.0 if found.max() > 1 else 1.0
        return bool(np.abs(found / scale - shares).max() < 1e-4)

    return kept


def _colors(values: NDArray[np.generic]) -> Callable[[Cloud], bool]:
    return lambda cloud: np.array_equal(np.asarray(cloud.colors), values)


@dataclass(frozen=True)
class Attribute:
    """A cloud with an attribute, and the question whether it is there unchanged."""

    cloud: Cloud
    kept: Callable[[Cloud], bool]


ATTRIBUTES = {
    "coordinates to 1e-6": Attribute(
        Cloud(POINTS), lambda cloud: bool(np.abs(cloud.points - POINTS).max() < 1.1e-6)
    ),
    "normals": Attribute(Cloud(POINTS, NORMALS), lambda cloud: cloud.normals is not None),
    "8-bit colours": Attribute(Cloud(POINTS, colors=RGB), _colors(RGB)),
    "16-bit colours": Attribute(Cloud(POINTS, colors=WIDE), _colors(WIDE)),
    "alpha": Attribute(Cloud(POINTS, colors=ALPHA), _colors(ALPHA)),
    "quantities": Attribute(
        Cloud(POINTS, scalars={"reflectance": REAL}), _same("reflectance", REAL)
    ),
    "intensity": Attribute(
        Cloud(POINTS, scalars={"intensity": INTENSITY}), _near("intensity", INTENSITY / 65535)
    ),
    "labels": Attribute(
        Cloud(POINTS, scalars={"classification": LABEL}), _same("classification", LABEL)
    ),
    "time": Attribute(Cloud(POINTS, scalars={"gps_time": TIME}), _same("gps_time", TIME)),
    "sensor position": Attribute(
        Cloud(POINTS, viewpoints=np.array([[441_000.0, 4_475_000.0, 350.0]])),
        lambda cloud: (
            cloud.viewpoints is not None
            and bool(np.abs(cloud.viewpoints - [441_000.0, 4_475_000.0, 350.0]).max() < 1e-3)
        ),
    ),
    "CRS": Attribute(
        Cloud(POINTS, source=SourceInfo("las", crs=WKT)),
        lambda cloud: cloud.source is not None and "UTM zone 32N" in (cloud.source.crs or ""),
    ),
}


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A service in this process on a real port."""
    folder = tmp_path_factory.mktemp("service")
    app = create_app(Settings(engine="inline", spool_dir=folder, jobs_dir=folder / "jobs"))
    server = uvicorn.Server(uvicorn.Config(app, log_config=None))
    listener = socket.create_server(("127.0.0.1", 0))
    thread = threading.Thread(target=server.run, args=([listener],))
    thread.start()
    url = f"http://127.0.0.1:{listener.getsockname()[1]}"
    end = time.monotonic() + 60
    while HTTP.get(f"{url}/health/ready", timeout=60).status_code != 200:
        assert time.monotonic() < end
        time.sleep(0.05)
    yield url
    server.should_exit = True
    thread.join(20)
    listener.close()


def by_command_line(files: list[Path], folder: Path) -> list[Path]:
    """The way of `pugeo upsample`."""
    out = [folder / f"cli-{path.name}" for path in files]
    tasks = [
        Task(path, target, None, path.parent.name) for path, target in zip(files, out, strict=True)
    ]
    for outcome in run_here(tasks, TaskSettings({"ratio": 1.0}), lambda *_: None):
        assert outcome.status == "written", outcome
    return out


def by_rest(files: list[Path], folder: Path, address: str) -> list[Path]:
    """The way of an HTTP client that names no format."""
    out = [folder / f"rest-{path.name}" for path in files]
    with httpx2.Client(timeout=60) as client:
        for path, target in zip(files, out, strict=True):
            answer = client.post(f"{address}/upsample?R=1", content=path.read_bytes())
            assert answer.status_code == 200, answer.text
            target.write_bytes(answer.content)
    return out


def by_sdk(files: list[Path], folder: Path, address: str) -> list[Path]:
    """The way of `pugeo_client`."""
    out = [folder / f"sdk-{path.name}" for path in files]
    with Client(address) as client:
        for path, target in zip(files, out, strict=True):
            client.upsample(path, ratio=1, out=target, format=path.parent.name)
    return out


def marks(files: list[Path], attributes: list[str]) -> list[str]:
    """Yes, or a dash, for each attribute."""
    clouds = [read(path) for path in files]
    return [
        "yes" if ATTRIBUTES[name].kept(cloud) else "-"
        for name, cloud in zip(attributes, clouds, strict=True)
    ]


def written(folder: Path, format: str) -> list[Path]:
    """A file for each attribute, in a format."""
    (folder / format).mkdir(parents=True)
    ending = (*WRITABLE[format].EXTENSIONS, ".ply")[0]
    files = []
    for number, attribute in enumerate(ATTRIBUTES.values()):
        path = folder / format / f"{number:02d}{ending}"
        buffer = io.BytesIO()
        write(attribute.cloud, buffer, format=format)
        path.write_bytes(buffer.getvalue())
        files.append(path)
    return files


@pytest.mark.slow
def test_the_table(address: str, tmp_path: Path) -> None:
    """The table of the page is what comes out, and all three routes give the same."""
    names = list(ATTRIBUTES)
    lines = [f"| format | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    for kind in sorted(WRITABLE):
        files = written(tmp_path, kind)
        found = {
            "command line": marks(by_command_line(files, tmp_path), names),
            "REST": marks(by_rest(files, tmp_path, address), names),
            "SDK": marks(by_sdk(files, tmp_path, address), names),
        }
        assert found["REST"] == found["command line"], kind
        assert found["SDK"] == found["command line"], kind
        for name, mark in zip(names, found["REST"], strict=True):
            noted = dropped(ATTRIBUTES[name].cloud, kind) is not None
            assert noted == (mark == "-"), f"the note of {kind} on {name}"
        lines.append(f"| `{kind}` | {' | '.join(found['REST'])} |")
    right = "\n".join(lines) + "\n"
    shown = PAGE.read_text("utf-8").partition(BEGIN)[2].partition(END)[0]
    assert shown == right, f"the page must show\n{right}"
