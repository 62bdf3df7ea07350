# SPDX-License-Identifier: Apache-2.0
"""The database as the jobs see it: short transactions that run in threads."""

import asyncio
import functools
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Concatenate, ParamSpec, TypeVar

import structlog
from sqlalchemy import Connection, Engine, create_engine, event, func, make_url, select
from sqlalchemy.exc import IntegrityError, SQLAlchemyError

from pugeo_service.http.plain_json import plain_json
from pugeo_service.jobs.schema import metadata
from pugeo_service.problems import ProblemError

__all__ = ["Database", "unavailable"]

P = ParamSpec("P")
T = TypeVar("T")
Work = Callable[Concatenate[Connection, P], T]

_log = structlog.stdlib.get_logger("pugeo.jobs")
_BUSY_S = 5.0
_THREADS = 4
# A database that says nothing for so long has failed; else all threads would wait for it.
_SILENCE_S = 15
_MAKING = 0x70756767  # any number that nobody else locks in this database


def unavailable(reason: str) -> ProblemError:
    """Return the refusal of whatever needs the jobs' database or folder."""
    detail = f"Jobs are not available at the moment ({reason}); POST /upsample works without them."
    return ProblemError(503, "jobs_unavailable", detail, retry_after=5)


class Database:
    """Runs functions of a connection as transactions, in a few threads of its own.

    The threads are its own because one that waits for a lock must not keep bodies from being
    spooled.

    Args:
        url: of SQLAlchemy; ``sqlite:///path`` or ``postgresql://...``.
    """

    def __init__(self, url: str) -> None:
        self._url = url
        self._engine: Engine | None = None
        self._opening = threading.Lock()
        self._threads = ThreadPoolExecutor(_THREADS, "pugeo-jobs")

    async def read(self, work: Work[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run ``work`` in a transaction that only reads.

        Raises:
            ProblemError: 503 where the database cannot be used.
        """
        return await self._run(False, functools.partial(_bound, work, args, kwargs))

    async def write(self, work: Work[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run ``work`` in a transaction that is on disk when this returns.

        Raises:
            ProblemError: 503 where the database cannot be used; it is then unknown whether the
                transaction took place.
            IntegrityError: a row of that key exists.
        """
        return await self._run(True, functools.partial(_bound, work, args, kwargs))

    def close(self) -> None:
        """Close all connections once the transactions under way have ended."""
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
            # Their text may hold addresses and values of rows: for the log alone.
            _log.error("the jobs' database fails", reason=f"{type(error).__name__}: {error}"[:500])
            raise unavailable("their database fails") from error

    def _transact(self, writes: bool, work: Callable[[Connection], T]) -> T:
        with self._opened().execution_options(pugeo_writes=writes).begin() as connection:
            return work(connection)

    def _opened(self) -> Engine:
        """Connect at the first use, and again at the next if it failed."""
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
        # Of two services that find no table and make one, the second would fail.
        connection.execute(select(func.pg_advisory_xact_lock(_MAKING)))
    metadata.create_all(connection)


def _engine(text: str) -> Engine:
    url = make_url(text)
    # A report or an error must never be what a job cannot be ended with.
    options: dict[str, Any] = {"json_serializer": lambda value: plain_json(value).decode()}
    if url.get_backend_name() == "postgresql":
        if url.drivername == "postgresql":
            url = url.set(drivername="postgresql+pg8000")
        options["connect_args"] = {"timeout": _SILENCE_S}
        return create_engine(url, pool_pre_ping=True, pool_size=_THREADS, max_overflow=0, **options)
    engine = create_engine(url, pool_size=_THREADS, max_overflow=0, **options)
    event.listen(engine, "connect", _prepare_sqlite)
    event.listen(engine, "begin", _begin_sqlite)
    return engine


def _prepare_sqlite(connection: Any, _record: object) -> None:
    # The driver's own idea of when a transaction begins leaves reads outside of it.
    connection.isolation_level = None
    cursor = connection.cursor()
    cursor.execute(f"PRAGMA busy_timeout={int(1000 * _BUSY_S)}")
    cursor.execute("PRAGMA journal_mode=WAL")
    # In WAL mode NORMAL may lose the last transactions in a power cut: an accepted job.
    cursor.execute("PRAGMA synchronous=FULL")
    cursor.close()


def _begin_sqlite(connection: Connection) -> None:
    # A transaction that begins as a reader and then writes fails at once when another one wrote
    # in between; one that begins as a writer waits its turn.
    writes = connection.get_execution_options().get("pugeo_writes", True)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")
