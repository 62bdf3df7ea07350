# SPDX-License-Identifier: Apache-2.0
"""Build the image with buildah, without a registry and without a daemon.

    python deploy/image/build.py [--base IMAGE]

Without ``--base`` the base is Debian bookworm, put together by debootstrap once. Both need root.
What pip is configured to on this machine (an index, a certificate, folders of wheels) is visible to
the build and is not part of the image. The image is written to ``.cache/image/oci`` as compressed
layers; ``skopeo copy oci:.cache/image/oci:latest docker://...`` sends it to a registry.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

ROOT = Path(__file__).resolve().parents[2]
STORE = ROOT / ".cache" / "image"
TAG = "localhost/pugeo:latest"
LAYERS = STORE / "oci"
_BASE = "localhost/pugeo-base:bookworm"
_SUITE = "bookworm"
_PACKAGES = "python3,python3-venv,ca-certificates"
_NOT_NEEDED = ("usr/share/doc", "usr/share/locale", "usr/share/man", "var/cache", "var/lib/apt")
_SHOWN = 16
_PIP_FILES = ("/etc/pip.conf", "/etc/xdg/pip", "/root/.config/pip", "/root/.pip")


def buildah(*arguments: str, output: bool = False) -> str:
    """Run buildah on the images of this project; return what it prints, if asked for."""
    command = ["buildah", "--root", str(STORE / "storage"), "--runroot", str(STORE / "run")]
    environment = os.environ | {"BUILDAH_ISOLATION": "chroot"}
    done = subprocess.run(
        [*command, *arguments],
        check=True,
        env=environment,
        text=True,
        stdout=subprocess.PIPE if output else None,
    )
    return done.stdout or ""


def missing(base: str | None) -> str | None:
    """Return a line about what building needs and this machine lacks, or ``None``."""
    if shutil.which("buildah") is None:
        return "there is no buildah (apt-get install buildah)"
    if os.geteuid() != 0:
        return "building without a daemon needs root here"
    if base is None and shutil.which("debootstrap") is None:
        return "there is no debootstrap for the base (apt-get install debootstrap), and no --base"
    return None


def has(image: str) -> bool:
    """Return True if an image of this name was built."""
    return image in buildah("images", "--format", "{{.Name}}:{{.Tag}}", output=True).split()


def make_base() -> None:
    """Make the base: Debian's smallest system with Python, less documents and package lists."""
    with tempfile.TemporaryDirectory(dir=STORE) as name:
        folder = Path(name) / "root"
        command = ["debootstrap", "--variant=minbase", f"--include={_PACKAGES}"]
        subprocess.run([*command, _SUITE, str(folder)], check=True)
        for path in _NOT_NEEDED:
            shutil.rmtree(folder / path, ignore_errors=True)
            (folder / path).mkdir()
        container = buildah("from", "scratch", output=True).strip()
        buildah("copy", "--quiet", container, str(folder), "/")
        buildah("config", "--env", "PATH=/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin", container)
        buildah("commit", "--quiet", "--rm", container, _BASE)


def pip_volumes() -> Iterator[str]:
    """Yield ``--volume`` options for the files that pip is configured to on this machine."""
    listed = subprocess.run(
        [sys.executable, "-m", "pip", "config", "list"], check=True, capture_output=True, text=True
    ).stdout
    paths = {Path(name) for name in _PIP_FILES}
    for line in listed.splitlines():
        for value in line.partition("=")[2].strip("'\"").split():
            url = urlsplit(value)
            if url.scheme in {"", "file"} and url.path.startswith("/"):
                paths.add(Path(url.path))
    for path in sorted(paths):
        if path.exists():
            # A folder of an index may hold links into its neighbours.
            whole = path.parent if path.name == "simple" else path
            yield f"--volume={whole}:{whole}:ro"


def main() -> int:
    """Read the command line and build; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--base", help="image to build on, instead of Debian by debootstrap")
    given = parser.parse_args()
    if reason := missing(given.base):
        sys.stdout.write(f"The image was not built: {reason}.\n")
        return 0
    try:
        build(given.base)
        weigh()
    except subprocess.CalledProcessError as error:
        program = " ".join(error.cmd[:1])
        sys.stderr.write(f"{program} ended with status {error.returncode}; its lines say why.\n")
        return 1
    return 0


def build(base: str | None) -> None:
    """Build on a base, and write the image as compressed layers."""
    STORE.mkdir(parents=True, exist_ok=True)
    if base is None and not has(_BASE):
        make_base()
    arguments = [
        "--format",
        "docker",
        "--layers",
        "--pull-never",
        "--build-arg",
        f"BASE={base or _BASE}",
    ]
    if url := os.environ.get("TORCH_INDEX_URL"):
        arguments += ["--build-arg", f"TORCH_INDEX_URL={url}"]
    buildah("build", *arguments, *pip_volumes(), "--tag", TAG, str(ROOT))
    shutil.rmtree(LAYERS, ignore_errors=True)
    buildah("push", "--quiet", TAG, f"oci:{LAYERS}:latest")


def weigh() -> None:
    """Print the size of the layers, and of the largest parts once unpacked."""
    layers = sum(path.stat().st_size for path in (LAYERS / "blobs").rglob("*") if path.is_file())
    container = buildah("from", "--pull-never", TAG, output=True).strip()
    try:
        folder = Path(buildah("mount", container, output=True).strip())
        packages = next((folder / "opt/venv/lib").glob("python3*/site-packages"))
        sizes = _sizes(folder, "") | _sizes(packages, "  ")
    finally:
        buildah("rm", container, output=True)
    sys.stdout.write(f"{layers / 1e6:8.0f} MB  compressed layers\n")
    for name, size in sorted(sizes.items(), key=lambda item: -item[1])[:_SHOWN]:
        sys.stdout.write(f"{size / 1e6:8.0f} MB  {name}\n")


def _sizes(folder: Path, indent: str) -> dict[str, int]:
    """Return the bytes of each entry of a folder."""
    command = ["du", "--bytes", "--summarize", "--one-file-system", *map(str, folder.iterdir())]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    pairs = (line.split("\t") for line in done.stdout.splitlines())
    return {f"{indent}{Path(path).name}": int(size) for size, path in pairs}


if __name__ == "__main__":
    sys.exit(main())
