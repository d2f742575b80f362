"""The jobs, in SQLite or PostgreSQL, through SQLAlchemy alone."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, cast

from sqlalchemy import JSON, Engine, String, Text, create_engine, event, func, select, update
from sqlalchemy.exc import ArgumentError, IntegrityError, NoSuchModuleError
from sqlalchemy.orm import DeclarativeBase, Mapped, Session, mapped_column

from deepshade.errors import ConfigError

if TYPE_CHECKING:
    from sqlalchemy import CursorResult, Update

QUEUED, RUNNING, DONE = "queued", "running", "done"
FAILED, CANCELLED = "failed", "cancelled"
AGAIN = (FAILED, CANCELLED)  # what asking again begins anew
OVER = (DONE, FAILED, CANCELLED)
STATES = (QUEUED, RUNNING, *OVER)


class Table(DeclarativeBase):
    """All tables."""


class Job(Table):
    """One job. Times are seconds since 1970; `place` orders the queue; `key` is what it depends on.

    `published` is the version's number, None where nothing was published; `sentence` says what came
    of it.
    """

    __tablename__ = "jobs"

    id: Mapped[str] = mapped_column(String(16), primary_key=True)
    key: Mapped[str] = mapped_column(String(64), unique=True)
    effect: Mapped[str] = mapped_column(String(64))
    name: Mapped[str] = mapped_column(String(64))
    asked: Mapped[dict[str, Any]] = mapped_column(JSON)
    state: Mapped[str] = mapped_column(String(16), index=True)
    place: Mapped[float] = mapped_column(index=True)
    created: Mapped[float]
    started: Mapped[float | None]
    ended: Mapped[float | None]
    begun: Mapped[int] = mapped_column(default=0)
    published: Mapped[int | None]
    sentence: Mapped[str] = mapped_column(Text, default="")
    fix: Mapped[str] = mapped_column(Text, default="")

    def document(self) -> dict[str, Any]:
        """As JSON values."""
        return {c.name: getattr(self, c.name) for c in self.__table__.columns if c.name != "place"}


class Store:
    """The table of jobs at a database URL. Safe to use from several threads.

    Raises ConfigError for a URL that can't be used, and SQLAlchemy's errors while the database is
    away.
    """

    def __init__(self, url: str) -> None:
        try:
            self._engine: Engine = create_engine(url, pool_pre_ping=True)
        except (ArgumentError, NoSuchModuleError) as error:
            raise ConfigError(
                "database",
                detail=f"--database can't be used: {error}; write sqlite:////folder/jobs.db or "
                "postgresql+psycopg://user:password@host/name",
            ) from error
        if self._engine.dialect.name == "sqlite":
            event.listen(self._engine, "connect", _durable)

    def prepare(self) -> None:
        """Make the tables where they aren't; jobs that were running when all was killed wait."""
        Table.metadata.create_all(self._engine)
        with self._session() as session:
            session.execute(update(Job).where(Job.state == RUNNING).values(state=QUEUED))

    def add(self, job: Job) -> tuple[Job, bool]:
        """The job of that key, and whether it waits anew: one that failed or was cancelled does."""
        try:
            with self._session() as session:
                session.add(job)
            return job, True
        except IntegrityError:
            now = time.time()
            anew = {"state": QUEUED, "place": now, "sentence": "", "fix": "", "ended": None}
            with self._session() as session:
                query = update(Job).where(Job.key == job.key, Job.state.in_(AGAIN))
                changed = _changed(session, query.values(anew))
                return session.scalars(select(Job).where(Job.key == job.key)).one(), bool(changed)

    def get(self, number: str) -> Job | None:
        """That job."""
        with self._session() as session:
            return session.get(Job, number)

    def jobs(self, limit: int = 1000) -> list[Job]:
        """The jobs, the one asked for last first."""
        with self._session() as session:
            return list(session.scalars(select(Job).order_by(Job.place.desc()).limit(limit)))

    def before(self, job: Job) -> int:
        """How many wait before that one."""
        with self._session() as session:
            query = select(func.count()).where(Job.state == QUEUED, Job.place < job.place)
            return session.scalars(query).one()

    def waiting(self) -> int:
        """How many wait in all."""
        with self._session() as session:
            return session.scalars(select(func.count()).where(Job.state == QUEUED)).one()

    def counts(self) -> dict[str, int]:
        """How many there are by state."""
        with self._session() as session:
            query = select(Job.state, func.count()).group_by(Job.state)
            return {state: int(count) for state, count in session.execute(query)}

    def published(self) -> int:
        """How many were published."""
        with self._session() as session:
            return session.scalars(select(func.count()).where(Job.published.is_not(None))).one()

    def in_state(self, state: str) -> list[Job]:
        """Those in a state, the first first."""
        with self._session() as session:
            return list(session.scalars(select(Job).where(Job.state == state).order_by(Job.place)))

    def oldest(self) -> float | None:
        """Since when the first that waits does; None where none waits."""
        with self._session() as session:
            return session.scalars(select(func.min(Job.place)).where(Job.state == QUEUED)).one()

    def claim(self) -> Job | None:
        """The first that waits, which now runs; None where none waits."""
        with self._session() as session:
            first = select(Job.id).where(Job.state == QUEUED).order_by(Job.place).limit(1)
            number = session.scalars(first).one_or_none()
            if number is None:
                return None
            values = {"state": RUNNING, "started": time.time(), "begun": Job.begun + 1}
            query = update(Job).where(Job.id == number, Job.state == QUEUED)
            claimed = _changed(session, query.values(values))
            return session.get(Job, number) if claimed else None

    def move(self, number: str, to: str, *, of: tuple[str, ...], **values: Any) -> bool:
        """Change a job's state, if it is one of those; whether it was."""
        if to in OVER:
            values.setdefault("ended", time.time())
        with self._session() as session:
            query = update(Job).where(Job.id == number, Job.state.in_(of))
            return bool(_changed(session, query.values(state=to, **values)))

    def close(self) -> None:
        """Close the connections."""
        self._engine.dispose()

    @contextmanager
    def _session(self) -> Iterator[Session]:
        with Session(self._engine, expire_on_commit=False) as session, session.begin():
            yield session


def _changed(session: Session, query: Update) -> int:
    """How many rows a query changed."""
    return cast("CursorResult[Any]", session.execute(query)).rowcount


def _durable(connection: Any, _: object) -> None:
    """SQLite: readers don't wait for a writer, and a commit survives a power cut."""
    cursor = connection.cursor()
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "busy_timeout=10000"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()
