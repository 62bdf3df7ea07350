# SPDX-License-Identifier: Apache-2.0
"""Settings that are addresses: of the service, its scheduler, database and store.

Libraries are imported where a URL is set: each worker loads the settings, and needs none of them.
"""

import ipaddress
import re
from importlib.util import find_spec

__all__ = ["check_database", "check_host", "check_scheduler", "check_store"]

_LABEL = r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?"
_NAME = re.compile(rf"{_LABEL}(\.{_LABEL})*\.?")
_SCHEDULER = re.compile(r"tls://(?:\[([^]]*:[^]]*)\]|([^\[\]:/@]*)):([0-9]{1,5})")
_MOST_BYTES_OF_A_NAME = 253


def check_host(value: str) -> str:
    """Return the address or name of a machine.

    Raises:
        ValueError: it has another form.
    """
    if not _is_host(value):
        raise ValueError(
            "must be an address or name of this machine, such as 127.0.0.1, or 0.0.0.0 or :: for "
            "all; without a port"
        )
    return value


def check_scheduler(value: str) -> str:
    """Return the address of a scheduler.

    Raises:
        ValueError: it has another form. A scheduler executes any code it receives, so only mutual
            TLS is allowed.
    """
    found = _SCHEDULER.fullmatch(value)
    if found is None or not _is_host(found[1] or found[2] or "") or int(found[3]) > 65_535:
        raise ValueError("must be tls://host:port")
    return value


def _is_host(value: str) -> bool:
    try:
        ipaddress.ip_address(value)
    except ValueError:
        return len(value) <= _MOST_BYTES_OF_A_NAME and _NAME.fullmatch(value) is not None
    return True


def check_database(value: str) -> str:
    """Return the URL of a database.

    Raises:
        ValueError: it has another form, or its driver is missing. The text does not quote the URL,
            which may contain a password.
    """
    wanted = "must be postgresql://user:password@host/name or sqlite:///path"
    if not value.startswith(("postgresql://", "sqlite:///")):
        raise ValueError(wanted)
    from sqlalchemy import make_url
    from sqlalchemy.exc import ArgumentError

    try:
        url = make_url(value)
    except (ArgumentError, ValueError):
        raise ValueError(wanted) from None
    if url.get_backend_name() == "postgresql" and find_spec("pg8000") is None:
        raise ValueError("PostgreSQL needs: pip install 'pugeo[postgres]'")
    return value


def check_store(value: str) -> str:
    """Return the URL of a folder of some store that fsspec knows.

    Raises:
        ValueError: it has another form, or the package of its protocol is missing.
    """
    protocol, separator, place = value.partition("://")
    if not separator or not place:
        raise ValueError("must be the URL of a folder, such as s3://bucket/prefix")
    import fsspec

    try:
        fsspec.get_filesystem_class(protocol)
    except (ImportError, ValueError) as error:
        raise ValueError(f"{error}; for s3:// pip install 'pugeo[store]'") from None
    return value
