# SPDX-License-Identifier: Apache-2.0
"""Database access for jobs: short transactions that run in threads."""

import asyncio
import functools
import json
import sqlite3
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

import structlog
from sqlalchemy import Connection, Engine, create_engine, event, func, make_url, select
from sqlalchemy.exc import IntegrityError, OperationalError, SQLAlchemyError

from pugeo_service.jobs.models import UnreadableRowError, metadata
from pugeo_service.json_encoding import encode_json
from pugeo_service.problems import ProblemError
from pugeo_service.storage.reserve import Reserve

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
        reserve: room on the disk of SQLite that `free` may use.
    """

    def __init__(self, url: str, reserve: Reserve | None = None) -> None:
        self._url = url
        self._reserve = reserve
        name = make_url(url).database if url.startswith("sqlite:") else None
        self._file = Path(name) if name else None
        self._inode: tuple[int, int] | None = None
        self._engine: Engine | None = None
        self._idle = threading.Condition()
        self._running = 0  # transactions, each in a thread
        self._threads = ThreadPoolExecutor(_THREADS, "pugeo-jobs")

    async def read(self, work: Work[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run ``work`` in a read-only transaction.

        Raises:
            ProblemError: 503, the database cannot be used; 500, the row of a job is damaged.
        """
        return await self._run(False, functools.partial(_bound, work, args, kwargs))

    async def write(self, work: Work[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run ``work`` in a transaction that is durable when this returns.

        Raises:
            ProblemError: 503, the database cannot be used; the transaction may have taken place.
            IntegrityError: a row with the same key exists.
        """
        return await self._run(True, functools.partial(_bound, work, args, kwargs))

    async def free(self, work: Work[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run a transaction that gives room back, as `write`; on a full disk it uses the reserve.

        Raises:
            ProblemError: 503, the database cannot be used.
        """
        bound = functools.partial(_bound, work, args, kwargs)
        return await self._run(True, bound, uses_reserve=True)

    def close(self) -> None:
        """Close all connections after the running transactions."""
        self._threads.shutdown(wait=True)
        if self._engine is not None:
            self._engine.dispose()

    async def _run(
        self, writes: bool, work: Callable[[Connection], T], *, uses_reserve: bool = False
    ) -> T:
        run = self._transact_anyhow if uses_reserve else self._transact
        try:
            loop = asyncio.get_running_loop()
            return await loop.run_in_executor(self._threads, run, writes, work)
        except IntegrityError:
            raise
        except UnreadableRowError as error:
            _log.error("row of a job cannot be read", reason=str(error))
            raise error.problem() from error
        except (SQLAlchemyError, OSError) as error:
            # The text may contain addresses and values of rows, so it is only logged.
            _log.error("database error", reason=f"{type(error).__name__}: {error}"[:500])
            raise unavailable("database error") from error

    def _transact_anyhow(self, writes: bool, work: Callable[[Connection], T]) -> T:
        try:
            return self._transact(writes, work)
        except OperationalError as error:
            full = getattr(error.orig, "sqlite_errorcode", None) == sqlite3.SQLITE_FULL
            if not full or self._reserve is None or not self._reserve.release():
                raise
            return self._transact(writes, work)

    def _transact(self, writes: bool, work: Callable[[Connection], T]) -> T:
        with (
            self._opened() as engine,
            engine.execution_options(pugeo_writes=writes).begin() as connection,
        ):
            return work(connection)

    @contextmanager
    def _opened(self) -> Iterator[Engine]:
        """Connect at the first use, and at later ones as long as it fails."""
        with self._idle:
            # A transaction on a removed file would not be part of the copy, and its connection
            # would delete the write-ahead log of the new file when it closes.
            while self._running and self._engine is not None and self._inode != _inode(self._file):
                self._idle.wait()
            if self._engine is not None and self._file is not None:
                self._restore_if_removed(self._engine, self._file)
            if self._engine is None:
                engine = _engine(self._url)
                try:
                    with engine.begin() as connection:
                        _make_table(connection)
                except BaseException:
                    engine.dispose()
                    raise
                self._engine = engine
                self._inode = _inode(self._file)
            engine = self._engine
            self._running += 1
        try:
            yield engine
        finally:
            with self._idle:
                self._running -= 1
                self._idle.notify_all()

    def _restore_if_removed(self, engine: Engine, path: Path) -> None:
        """Write a SQLite file that was removed or replaced once more, and connect to it anew.

        Connections that are open still reach the removed file with all its rows, which would be
        lost at the end of this process.

        Raises:
            OSError, SQLAlchemyError: it cannot be written.
        """
        found = _inode(path)
        if found == self._inode:
            return
        if found is None:
            part = path.with_name(f"{path.name}.restored")
            with engine.connect() as connection, closing(sqlite3.connect(part)) as copy:
                source: Any = connection.connection.driver_connection
                source.backup(copy)
            for stale in ("-wal", "-shm"):
                path.with_name(path.name + stale).unlink(missing_ok=True)
            part.replace(path)
            _log.error("the database file was removed; it was written again", file=path.name)
        else:
            _log.error("the database file was replaced; the new one is used", file=path.name)
        self._engine = None
        engine.dispose()


def _bound(
    work: Callable[..., T], args: tuple[Any, ...], kwargs: dict[str, Any], connection: Connection
) -> T:
    return work(connection, *args, **kwargs)


def _inode(path: Path | None) -> tuple[int, int] | None:
    """Return a value that another file of the same name does not have; ``None`` without a file."""
    try:
        status = None if path is None else path.stat()
    except FileNotFoundError:
        return None
    return None if status is None else (status.st_dev, status.st_ino)


def _make_table(connection: Connection) -> None:
    if connection.dialect.name == "postgresql":
        # If two services create the table at the same time, the second would fail.
        connection.execute(select(func.pg_advisory_xact_lock(_CREATE_LOCK)))
    metadata.create_all(connection)


def _engine(text: str) -> Engine:
    url = make_url(text)
    # Reports and errors may contain any value; encoding them must not fail.
    options: dict[str, Any] = {
        "json_serializer": lambda value: encode_json(value).decode(),
        "json_deserializer": _lenient_json,
    }
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
    # A damaged text must not make the other rows of its query unreadable.
    connection.text_factory = _lenient_text
    cursor = connection.cursor()
    cursor.execute(f"PRAGMA busy_timeout={int(1000 * _BUSY_S)}")
    cursor.execute("PRAGMA journal_mode=WAL")
    # In WAL mode NORMAL may lose the last transactions, thus accepted jobs, in a power cut.
    cursor.execute("PRAGMA synchronous=FULL")
    cursor.close()


def _lenient_text(data: bytes) -> str:
    return data.decode("utf-8", "replace")


def _lenient_json(text: str) -> Any:
    """Return the value of a JSON text, or the text itself; `Job.from_row` refuses that."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def _begin_sqlite(connection: Connection) -> None:
    # A transaction that begins by reading fails at its first write if another one has written
    # meanwhile; one that begins by writing waits for the lock.
    writes = connection.get_execution_options().get("pugeo_writes", True)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")
