# SPDX-License-Identifier: Apache-2.0
"""Commands that install a missing extra, for messages. Loads the standard library alone."""

import json
from importlib.metadata import Distribution, PackageNotFoundError

__all__ = ["install_hint"]


def install_hint(extra: str) -> str:
    """The command that installs an extra of pugeo from where pugeo itself was installed.

    Installers record the address of a wheel, an archive or a checkout (PEP 610); without such a
    record pugeo came from an index, or is run from a checkout that is not installed.

    Args:
        extra: such as ``model``.
    """
    try:
        record = Distribution.from_name("pugeo").read_text("direct_url.json")
        url = json.loads(record)["url"] if record else None
    except (PackageNotFoundError, ValueError, KeyError, TypeError):
        url = None
    return f"pip install 'pugeo[{extra}]{'' if url is None else f' @ {url}'}'"
