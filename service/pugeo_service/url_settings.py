# SPDX-License-Identifier: Apache-2.0
"""Settings that are URLs: the database of jobs, and the store of their files.

Libraries are imported where a URL is set: each worker loads the settings, and needs none of them.
"""

from importlib.util import find_spec

__all__ = ["check_database", "check_store"]


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
