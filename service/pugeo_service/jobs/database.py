# SPDX-License-Identifier: Apache-2.0
"""Database access for jobs: short transactions that run in threads."""

import asyncio
import functools
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Concatenate, ParamSpec, TypeVar

import structlog
from sqlalchemy import Connection, Engine, create_engine, event, func, make_url, select
from sqlalchemy.exc import IntegrityError, SQLAlchemyError

from pugeo_service.jobs.models import metadata
from pugeo_service.json_encoding import encode_json
from pugeo_service.problems import ProblemError

__all__ = ["Database", "unavailable"]

P = ParamSpec("P")
T = TypeVar("T")
Work = Callable[Concatenate[Connection, P], T]

_log = structlog.stdlib.get_logger("pugeo.jobs")
_BUSY_S = 5.0  # wait for a lock of SQLite
_THREADS = 4
_RESPONSE_S = 15  # wait for PostgreSQL; without a limit all threads could block
_CREATE_LOCK = 0x70756767  # key of an advisory lock; any number


def unavailable(reason: str) -> ProblemError:
    """Return the problem for requests that need the database or the folder of jobs."""
    detail = f"Jobs are not available ({reason}); try again later, or use POST /upsample."
    return ProblemError(503, "jobs_unavailable", detail, retry_after=5)


class Database:
    """Runs functions of a connection as transactions, in separate threads.

    The threads are separate, so that waiting for a database lock does not delay writing of bodies.

    Args:
        url: SQLAlchemy URL, ``sqlite:///path`` or ``postgresql://...``.
    """

    def __init__(self, url: str) -> None:
        self._url = url
        self._engine: Engine | None = None
        self._opening = threading.Lock()
        self._threads = ThreadPoolExecutor(_THREADS, "pugeo-jobs")

    async def read(self, work: Work[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run ``work`` in a read-only transaction.

        Raises:
            ProblemError: 503, the database cannot be used.
        """
        return await self._run(False, functools.partial(_bound, work, args, kwargs))

    async def write(self, work: Work[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run ``work`` in a transaction that is durable when this returns.

        Raises:
            ProblemError: 503, the database cannot be used; the transaction may have taken place.
            IntegrityError: a row with the same key exists.
        """
        return await self._run(True, functools.partial(_bound, work, args, kwargs))

    def close(self) -> None:
        """Close all connections after the running transactions."""
        self._threads.shutdown(wait=True)
        if self._engine is not None:
            self._engine.dispose()

    async def _run(self, writes: bool, work: Callable[[Connection], T]) -> T:
        try:
            loop = asyncio.get_running_loop()
            return await loop.run_in_executor(self._threads, self._transact, writes, work)
        except IntegrityError:
            raise
        except (SQLAlchemyError, OSError) as error:
            # The text may contain addresses and values of rows, so it is only logged.
            _log.error("database error", reason=f"{type(error).__name__}: {error}"[:500])
            raise unavailable("database error") from error

    def _transact(self, writes: bool, work: Callable[[Connection], T]) -> T:
        with self._opened().execution_options(pugeo_writes=writes).begin() as connection:
            return work(connection)

    def _opened(self) -> Engine:
        """Connect at the first use, and at later ones as long as it fails."""
        with self._opening:
            if self._engine is None:
                engine = _engine(self._url)
                try:
                    with engine.begin() as connection:
                        _make_table(connection)
                except BaseException:
                    engine.dispose()
                    raise
                self._engine = engine
            return self._engine


def _bound(
    work: Callable[..., T], args: tuple[Any, ...], kwargs: dict[str, Any], connection: Connection
) -> T:
    return work(connection, *args, **kwargs)


def _make_table(connection: Connection) -> None:
    if connection.dialect.name == "postgresql":
        # If two services create the table at the same time, the second would fail.
        connection.execute(select(func.pg_advisory_xact_lock(_CREATE_LOCK)))
    metadata.create_all(connection)


def _engine(text: str) -> Engine:
    url = make_url(text)
    # Reports and errors may contain any value; encoding them must not fail.
    options: dict[str, Any] = {"json_serializer": lambda value: encode_json(value).decode()}
    if url.get_backend_name() == "postgresql":
        if url.drivername == "postgresql":
            url = url.set(drivername="postgresql+pg8000")
        options["connect_args"] = {"timeout": _RESPONSE_S}
        return create_engine(url, pool_pre_ping=True, pool_size=_THREADS, max_overflow=0, **options)
    engine = create_engine(url, pool_size=_THREADS, max_overflow=0, **options)
    event.listen(engine, "connect", _prepare_sqlite)
    event.listen(engine, "begin", _begin_sqlite)
    return engine


def _prepare_sqlite(connection: Any, _record: object) -> None:
    # Disable the driver's implicit transactions, which do not include reads.
    connection.isolation_level = None
    cursor = connection.cursor()
    cursor.execute(f"PRAGMA busy_timeout={int(1000 * _BUSY_S)}")
    cursor.execute("PRAGMA journal_mode=WAL")
    # In WAL mode NORMAL may lose the last transactions, thus accepted jobs, in a power cut.
    cursor.execute("PRAGMA synchronous=FULL")
    cursor.close()


def _begin_sqlite(connection: Connection) -> None:
    # A transaction that begins by reading fails at its first write if another one has written
    # meanwhile; one that begins by writing waits for the lock.
    writes = connection.get_execution_options().get("pugeo_writes", True)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")
