# SPDX-License-Identifier: Apache-2.0
"""Print what extras of pyproject.toml require, without pugeo itself.

The image installs this first, so that a change of the source does not install torch anew.
"""

import sys
import tomllib
from pathlib import Path


def requirements(extra: str, extras: dict[str, list[str]]) -> list[str]:
    """List the requirements of an extra, and of those extras that it names."""
    found: list[str] = []
    for requirement in extras[extra]:
        if requirement.startswith("pugeo["):
            for name in requirement[6:].rstrip("]").split(","):
                found += requirements(name, extras)
        else:
            found.append(requirement)
    return found


if __name__ == "__main__":
    project = tomllib.loads(Path("pyproject.toml").read_text("utf-8"))["project"]
    lines = [*project["dependencies"]]
    for extra in sys.argv[1:]:
        lines += requirements(extra, project["optional-dependencies"])
    sys.stdout.write("\n".join(dict.fromkeys(lines)) + "\n")
