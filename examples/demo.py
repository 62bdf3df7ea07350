# SPDX-License-Identifier: Apache-2.0
"""Start the service, send it a cloud through the SDK, and draw what came back.

python examples/demo.py [CLOUD] [--ratio 8] [--out out]
"""

import argparse
import contextlib
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from pugeo_client import Client, Meta, PugeoError, Result
from pugeo_model.kernel_cache import compile_kernels
from pugeo_model.metrics.rasteriser import BACKGROUND, Camera, splat

HERE = Path(__file__).parent
START_SECONDS = 180.0
STOP_SECONDS = 60.0
LONGEST_LINE = 500


def main() -> None:
    """Run the demo and report what happened."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("cloud", nargs="?", type=Path, default=HERE / "knot.ply")
    parser.add_argument("--ratio", type=float, default=8.0, help="how many times as many points")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder to write to")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)

    compile_kernels(lambda sentence: print(sentence, flush=True))
    print("starting the service ...", flush=True)
    with running_service() as url, Client(url) as client:
        print(f"sending {options.cloud} to {url}/upsample?R={options.ratio:g} ...", flush=True)
        started = time.perf_counter()
        dense = client.upsample(options.cloud, options.ratio, out=options.out / "dense.ply")
        seconds = time.perf_counter() - started
    report(dense, seconds)

    print("drawing ...", flush=True)
    sparse = Result(Meta(), format="ply", path=options.cloud)
    picture = options.out / "before_after.png"
    draw(sparse, dense, seconds, picture)
    print(f"wrote {dense.path} and {picture}")


@contextlib.contextmanager
def running_service() -> Iterator[str]:
    """Run the service on a free port while the block lasts, and stop it however the block ends.

    Yields:
        The service's address.

    Raises:
        SystemExit: it did not become ready, or a call failed; the end of its log says why.
    """
    command = [sys.executable, "-m", "pugeo_service", "--port", "0", "--log-level", "warning"]
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,  # Ctrl-C reaches this program alone, which then stops the service
    )
    log: deque[str] = deque(maxlen=40)
    address: list[str] = []
    assert process.stdout is not None
    reader = threading.Thread(target=_read, args=(process.stdout, log, address), daemon=True)
    reader.start()
    try:
        _wait_until_ready(process, log, address)
        yield address[0]
    except PugeoError as error:
        sys.exit(f"{error}\nthe end of the service's log:\n{_end(log)}")
    finally:
        process.terminate()
        try:
            process.wait(STOP_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        reader.join(5)


def _read(stream: IO[str], log: deque[str], address: list[str]) -> None:
    """Keep the end of the service's output, and the address it prints when it listens."""
    for line in stream:
        log.append(line)
        if line.startswith("pugeo serves "):
            address.append(line.split()[-1])
    stream.close()


def _wait_until_ready(process: subprocess.Popen[str], log: deque[str], address: list[str]) -> None:
    end = time.monotonic() + START_SECONDS
    while time.monotonic() < end and process.poll() is None:
        if address:
            with Client(address[0], timeout=10) as client:
                if client.health()["status"] == "ready":
                    return
        time.sleep(0.2)
    sys.exit("the service did not become ready; the end of its log:\n" + _end(log))


def _end(log: deque[str]) -> str:
    """The last lines of a log, without the ends of those that go on for pages."""
    return "".join(f"{line.rstrip()[:LONGEST_LINE]}\n" for line in log)


def report(dense: Result, seconds: float) -> None:
    """Print what came back and how long it took."""
    meta = dense.meta
    print(f"  points   {meta.points_in:,} in, {len(dense):,} out")
    print(f"  time     {seconds:.2f} s, {len(dense) / seconds:,.0f} points a second")
    stages = ", ".join(f"{name} {spent:.2f}" for name, spent in meta.timings.items())
    print(f"  stages   {stages}")
    print(f"  model    version {meta.model_version}, weights {meta.model_sha256[:12]}")
    for note in meta.notes:
        print(f"  note     {note}")


def draw(sparse: Result, dense: Result, seconds: float, target: Path) -> None:
    """Draw the input, the output, and the output's surface by its normals, side by side."""
    before, after = (np.asarray(cloud.points, dtype=np.float64) for cloud in (sparse, dense))
    camera = Camera.on(before)
    gap = _spacing(before) * (len(before) / len(after)) ** 0.5  # of the denser cloud
    normals = None if dense.normals is None else np.asarray(dense.normals, dtype=np.float64)
    panels = [
        (
            splat(camera, before, _colors(sparse, before), radius=0.3 * _spacing(before)),
            "sent",
            f"{len(before):,} points",
        ),
        (
            splat(camera, after, _colors(dense, after), radius=0.36 * gap),
            "came back",
            f"{len(after):,} points in {seconds:.1f} s",
        ),
        (
            splat(camera, after, _colors(dense, after), radius=1.5 * gap, normals=normals),
            "lit by its normals",
            "every point a small disc, no mesh",
        ),
    ]
    _write_figure(panels, target)


def _spacing(points: NDArray[np.float64]) -> float:
    """Median distance to the nearest neighbour, cloud units."""
    from scipy.spatial import cKDTree

    distance = np.asarray(cKDTree(points).query(points, 2)[0])
    return float(np.median(distance[:, 1]))


def _colors(cloud: Result, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The cloud's own colours, linear; or a blue that pales with height where it has none."""
    if cloud.colors is not None:
        return np.asarray((cloud.colors[:, :3] / 255.0) ** 2.2)
    height = points[:, 1] - points[:, 1].min()
    height /= height.max() or 1.0
    low, high = np.array([0.10, 0.25, 0.55]), np.array([0.65, 0.80, 0.95])
    return np.asarray(low + height[:, None] * (high - low))


def _write_figure(panels: list[tuple[NDArray[np.float64], str, str]], target: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    background = tuple(BACKGROUND ** (1 / 2.2))
    side = panels[0][0].shape[0] / 100
    figure = plt.figure(figsize=(len(panels) * side, side + 1.1), dpi=100, facecolor=background)
    for index, (image, title, caption) in enumerate(panels):
        left, width = index / len(panels), 1 / len(panels)
        axes = figure.add_axes((left, 1.1 / (side + 1.1), width, side / (side + 1.1)))
        axes.imshow(image, interpolation="none")
        axes.set_axis_off()
        middle = left + width / 2
        figure.text(middle, 0.085, title, color="#f2f4f8", size=21, ha="center", weight="bold")
        figure.text(middle, 0.04, caption, color="#9aa4b5", size=15, ha="center")
    figure.savefig(target, facecolor=background)
    plt.close(figure)


if __name__ == "__main__":
    main()
