# SPDX-License-Identifier: Apache-2.0
"""The one table, in words that SQLite and PostgreSQL both understand."""

from sqlalchemy import (
    JSON,
    BigInteger,
    Column,
    Double,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    UniqueConstraint,
)

__all__ = ["jobs", "metadata"]

metadata = MetaData()

# Times are plain seconds: SQLite has no type for them, and every comparison stays one of numbers.
jobs = Table(
    "pugeo_jobs",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("owner", String(64), nullable=False),
    Column("state", String(16), nullable=False),
    Column("revision", Integer, nullable=False),
    Column("idempotency_key", String(255)),
    Column("request_digest", String(64), nullable=False),
    Column("request_id", String(128), nullable=False),
    Column("options", JSON, nullable=False),
    Column("format", String(32)),
    Column("answer", String(32), nullable=False),
    Column("input_bytes", BigInteger, nullable=False),
    Column("input_sha256", String(64), nullable=False),
    Column("created_at", Double, nullable=False),
    Column("stage", String(32), nullable=False),
    Column("patches_done", Integer, nullable=False),
    Column("patches_total", Integer),
    Column("attempts", Integer, nullable=False),
    Column("runner", String(64)),
    Column("not_before", Double, nullable=False),
    Column("started_at", Double),
    Column("finished_at", Double),
    Column("expires_at", Double),
    Column("result_bytes", BigInteger),
    Column("result_sha256", String(64)),
    Column("report", JSON(none_as_null=True)),
    Column("timings", JSON(none_as_null=True)),
    Column("model", JSON(none_as_null=True)),
    Column("problem", JSON(none_as_null=True)),
    # Rows without a key do not collide: NULL equals nothing, in both databases.
    UniqueConstraint("owner", "idempotency_key", name="pugeo_jobs_key"),
    Index("pugeo_jobs_state", "state", "id"),
    Index("pugeo_jobs_owner", "owner", "id"),
)
