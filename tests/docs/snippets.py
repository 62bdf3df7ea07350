# SPDX-License-Identifier: Apache-2.0
"""Snippets of a Markdown page: fenced blocks, each with its language, directives and output."""

import re
from dataclasses import dataclass
from pathlib import Path

__all__ = ["RUN", "SHOWN", "Snippet", "pages", "snippets"]

RUN = frozenset({"sh", "python"})
SHOWN = frozenset({"text", "json"})
"""Output of the snippet before it, or, after prose, nothing that is run."""

_BLOCK = re.compile(
    r"(?:^<!-- test: (?P<directives>[^\n]*) -->\n)?"
    r"^```(?P<language>[^\n]*)\n(?P<code>.*?)^```$(?P<after>\n\s*(?=```(?:text|json)\n))?",
    re.MULTILINE | re.DOTALL,
)


@dataclass
class Snippet:
    """A fenced block.

    Attributes:
        place: page and line, for messages.
        language: after the fence.
        code: between the fences.
        fails: the page shows it failing.
        needs: a command or a Python module that the project does not bring along.
        output: of the block that follows at once, or ``None``.
    """

    place: str
    language: str
    code: str
    fails: bool = False
    needs: str | None = None
    output: "Snippet | None" = None


def pages(root: Path) -> list[Path]:
    """The pages of the documentation, those in the root of the repository first."""
    return [*sorted(root.glob("*.md")), *sorted((root / "docs").rglob("*.md"))]


def snippets(page: Path, root: Path) -> list[Snippet]:
    """All fenced blocks of a page in their order; output belongs to the block before it."""
    text = page.read_text("utf-8")
    found: list[Snippet] = []
    wanted = False
    for match in _BLOCK.finditer(text):
        line = text.count("\n", 0, match.start("code"))
        directives = (match["directives"] or "").split()
        snippet = Snippet(
            place=f"{page.relative_to(root)}:{line}",
            language=match["language"],
            code=match["code"],
            fails="fails" in directives,
            needs=directives[directives.index("needs") + 1] if "needs" in directives else None,
        )
        if wanted and snippet.language in SHOWN:
            found[-1].output = snippet
        else:
            found.append(snippet)
        wanted = match["after"] is not None and snippet.language in RUN
    return found
