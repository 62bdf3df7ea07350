# SPDX-License-Identifier: Apache-2.0
"""The site builds strictly, and a browser without the internet has all of it."""

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
from tests.docs.snippets import pages

ROOT = Path(__file__).resolve().parents[2]
_LINK = re.compile(r"(?<!!)\[[^\]]*\]\(([^)\s]+)\)|!\[[^\]]*\]\(([^)\s]+)\)")


class Loaded(HTMLParser):
    """Addresses that a browser loads by itself: scripts, styles, images, fonts, frames."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect what a tag loads; a link to click on loads nothing."""
        if tag == "a":
            return
        for name, value in attrs:
            if name in {"src", "srcset", "data", "poster"} or (name == "href" and tag != "base"):
                self.addresses.append(value or "")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site."""
    target = tmp_path_factory.mktemp("site")
    # A proxy that is not there: whatever would be fetched fails.
    nowhere = "http://127.0.0.1:9"
    environment = os.environ | {
        "NO_MKDOCS_2_WARNING": "1", "http_proxy": nowhere, "https_proxy": nowhere,
    }  # fmt: skip
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(target)]
    built = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert built.returncode == 0, built.stdout + built.stderr
    return target


@pytest.mark.slow
def test_it_loads_nothing_from_elsewhere(site: Path) -> None:
    """Scripts, styles, images and fonts of every page lie in the site itself."""
    found = sorted(site.rglob("*.html"))
    assert len(found) > 20
    for page in found:
        parser = Loaded()
        parser.feed(page.read_text("utf-8"))
        assert parser.addresses
        foreign = [a for a in parser.addresses if re.match(r"(\w+:)?//", a)]
        assert not foreign, page.relative_to(site)
        for address in parser.addresses:
            path = re.sub(r"[?#].*", "", address)
            if path and not path.startswith("data:") and page.name != "404.html":
                assert (page.parent / path).exists(), f"{page.relative_to(site)}: {address}"
    for style in site.rglob("*.css"):
        assert not re.search(r"url\(['\"]?(\w+:)?//", style.read_text("utf-8")), style.name


@pytest.mark.slow
def test_no_diagram_needs_a_script_from_elsewhere(site: Path) -> None:
    """The theme would fetch a script for Mermaid diagrams and formulas; no page has one."""
    for page in site.rglob("*.html"):
        assert not re.search(r'class="(mermaid|arithmatex)"', page.read_text("utf-8")), page.name


@pytest.mark.parametrize("page", pages(ROOT), ids=lambda page: str(page.relative_to(ROOT)))
def test_links_of_the_repository(page: Path) -> None:
    """Links between files lead somewhere, also where the pages are read without the site."""
    for link, image in _LINK.findall(page.read_text("utf-8")):
        path = (link or image).partition("#")[0]
        if path and not re.match(r"\w+:", path):
            assert (page.parent / path).exists(), f"{page.relative_to(ROOT)}: {path}"
