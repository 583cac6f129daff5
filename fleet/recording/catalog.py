"""Answers SQL questions about all recorded sessions, with DuckDB over their tables. Each topic is one view.

`sensor_range` has the messages of `sensor/range` of every car in every session, with the columns of
`fleet sessions export` and the name of the `session`. `sensor_range_context` adds what was true at that time: the mode
as commanded and as seen, the motion, who drove, and the phase of the plan. The columns `owner` and `driver` of the
context are persons. `sender` and other columns are as recorded: `person_of(sender)` is the person. Topics without a
message have views, too. Sessions that a tool made from others (cut, merge, recover) count like all others. So if both
are in the directory, their common messages are in a view twice.

A view is defined only when a question names it or asks which views there are, because DuckDB then opens its files: a
thousand sessions have twenty files each.
"""

import os
import re
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from itertools import chain, count
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct

from fleet.recording.left_out import LeftOut
from fleet.recording.reading.session import NoSession
from fleet.recording.session_lookup import sessions_in, sessions_place
from fleet.recording.tools.table_cache import CachedTables, drop_orphans, tables_of
from fleet.recording.tools.table_formats import ArrowSink, FormatMissing, import_pyarrow
from fleet.recording.tools.tables import Layout
from schemas import messages, topics
from schemas.printable import printable_lines
from schemas.suggestion import did_you_mean
from schemas.topics import TOPICS, Topic

if TYPE_CHECKING:
    import pyarrow as pa  # type: ignore[import-untyped]  # it has no stubs

MEMORY_LIMIT: Final = "1GB"
"""Maximum memory of a question. Beyond it, DuckDB writes to a temporary directory."""
CONTEXT: Final[tuple[tuple[str, tuple[tuple[str, str], ...]], ...]] = (
    ("state/mode", (("mode", "{c}.asked"), ("mode_seen", "{c}.inferred"), ("verdict", "{c}.verdict"))),
    ("state/motion", (("motion", "{c}.motion"), ("owner", "person_of({c}.owner)"))),
    ("state/safety", (("motors", "{c}.motors"), ("driver", "person_of(json_extract_string({c}.lease, '$.holder'))"))),
    ("@coordinator/assignment", (("plan_phase", "{c}.phase"), ("plan_version", "{c}.plan_version"))),
)
"""Columns that `..._context` adds: for each topic, the names and expressions. `{c}` is the row of the topic."""


_PERSON_OF: Final = (
    "CREATE MACRO person_of(sender) AS coalesce(nullif(split_part(sender, '@', 1), ''), nullif(sender, ''))"
)
"""`schemas.keys.name_of` for questions: the person of a sender, without the host and the process."""
MAX_QUERY_ATTEMPTS: Final = 4
"""Maximum number of attempts for one question. Each looks for the sessions again, because the quota may have deleted
some, and sessions that grow get new tables."""
_ASKS_FOR_VIEWS: Final = re.compile(r"\b(show|pragma|information_schema|query_table|duckdb_\w+|pg_\w+|sqlite_\w+)\b")
_NO_TABLE: Final = re.compile(r"Table with name (.+?) does not exist!")


class BadQuery(ValueError):
    """A question that DuckDB does not understand. The text is one line: DuckDB's, or that there is no such table."""


class QueryFailed(RuntimeError):
    """A question that failed because of memory, disk or files. The text is one line: that of DuckDB, or advice."""


class Catalog:
    """The sessions of a directory, for SQL questions: `Catalog().query("SELECT min(range_m) FROM sensor_range")`.

    Each topic is a view, such as `sensor_range`. `directory` is `./sessions` by default, or, if there is none, the
    directory that `record` names in the fleet file here. `on_session` is called for each session that is looked at.
    `damage` lists the parts that could not be read. Raises FormatMissing without the extra `analysis`, QueryFailed
    without a directory for temporary files, and OSError if `directory` cannot be listed.
    """

    def __init__(
        self,
        directory: str | PathLike[str] | None = None,
        *,
        on_session: Callable[[Path], None] | None = None,
    ) -> None:
        """`directory`: None for `sessions_place()`. `on_session` is called for each session that is looked at."""
        try:
            import duckdb
        except ImportError:
            raise FormatMissing("duckdb") from None
        self._duckdb = duckdb
        self.directory = Path(directory) if directory is not None else sessions_place()
        if directory is not None:
            os.scandir(directory).close()  # a wrong one is no directory without sessions
        self.damage: dict[str, str] = {}
        """By name of a session: the parts that could not be read, in words."""
        self.unanswered: dict[str, str] = {}
        """By name of a session: why its tables could not be written anywhere. While there is such a session, every
        question fails."""
        self.sessions: list[CachedTables] = []
        self._on_session = on_session
        self._views: set[str] = set()
        self._casts: list[_Cast] = []
        try:
            scratch = tempfile.mkdtemp(prefix="zenoh-car-fleet-query-")
        except OSError as error:
            raise QueryFailed(
                f"no temporary file can be written: {error.strerror or error}. Make room, or set TMPDIR."
            ) from None
        # Otherwise DuckDB would write to `.tmp` in the current directory, which may be read-only.
        weakref.finalize(self, shutil.rmtree, scratch, ignore_errors=True)
        self._config: dict[str, Any] = {"memory_limit": MEMORY_LIMIT, "temp_directory": scratch}
        self._database: Any = None
        self._find()

    def _find(self) -> None:
        """Find the sessions, and forget all views."""
        self.damage.clear()
        self.unanswered.clear()
        self.sessions.clear()
        drop_orphans(self.directory)
        for path in sorted(sessions_in(self.directory), key=str):  # texts compare much faster than paths
            if self._on_session is not None:
                self._on_session(path)
            try:
                cached = tables_of(path)
            except NoSession as error:
                self.damage[path.name] = str(error)
                continue
            except OSError as error:
                self.unanswered[path.name] = error.strerror or str(error)
                continue
            self.sessions.append(cached)
            if cached.words:
                self.damage[path.name] = cached.words
        if self._database is not None:
            self._database.close()
        self._database = self._duckdb.connect(config=self._config)
        self._database.execute("SET TimeZone = 'UTC'")
        self._database.execute(_PERSON_OF)
        self._views.clear()
        self._casts.clear()

    def _define(self, words: str | None) -> None:
        """Define the views whose names are in a text, and those that they need. None means all views."""
        text = None if words is None or _ASKS_FOR_VIEWS.search(words.lower()) else words.lower()
        named = {topic.name for topic in TOPICS.values() if text is None or view_name(topic.name) in text}
        contexts = {
            name
            for name in named
            if TOPICS[name].family == "sensor" and (text is None or f"{view_name(name)}_context" in text)
        }
        if contexts:
            named |= {other for other, _ in CONTEXT}
        for name in sorted(named):
            if name not in self._views:
                self._add_view(TOPICS[name])
                self._views.add(name)
        for name in sorted(contexts):
            if (view := f"{view_name(name)}_context") not in self._views:
                self._add_context(TOPICS[name])
                self._views.add(view)

    def tables(self) -> dict[str, list[str]]:
        """Return the names of all views, each with its columns."""
        self._define(None)
        found = self._database.execute(
            "SELECT table_name, column_name FROM information_schema.columns "
            "WHERE table_name NOT LIKE 'empty_%' ORDER BY table_name, ordinal_position"
        ).fetchall()
        columns: dict[str, list[str]] = {}
        for table, column in found:
            columns.setdefault(table, []).append(column)
        return columns

    def query(self, sql: str, parameters: Sequence[Any] = ()) -> "pa.Table":
        """Return the answer to a question in SQL as a pyarrow.Table. Raises BadQuery, QueryFailed."""
        attempts = MAX_QUERY_ATTEMPTS
        while True:
            try:
                return self._answer(sql, parameters)
            except self._duckdb.Error as error:
                attempts -= 1
                if not attempts or not _is_gone(error):
                    kind = QueryFailed if isinstance(error, self._duckdb.OperationalError) else BadQuery
                    raise kind(_no_table(str(error)) or _one_line(str(error))) from None
            self._find()

    def _answer(self, sql: str, parameters: Sequence[Any]) -> "pa.Table":
        if self.unanswered:  # the answer would lack the messages of these sessions
            name, why = next(iter(self.unanswered.items()))
            which = f"{name} and {more} more" if (more := len(self.unanswered) - 1) else name
            raise QueryFailed(
                printable_lines(f"the tables of {which} cannot be written anywhere: {why}. Make room, or set TMPDIR.")
            )
        self._define(sql)
        answer: Any = self._database.sql(sql, params=list(parameters) or None)
        return import_pyarrow().table({}) if answer is None else answer.to_arrow_table()

    def left_out(self) -> dict[str, LeftOut]:
        """Say which messages of each session are in no view, because they cannot be decoded or have another type.

        Only topics for which a question has asked so far are counted.
        """
        found: dict[str, LeftOut] = {}
        for cached in self.sessions:
            with suppress(OSError):  # the session was deleted since the question
                for (key, cause), count in cached.left_out().counts.items():
                    topic = topics.of_key(key)
                    if topic is not None and topic.name in self._views:
                        found.setdefault(cached.session.name, LeftOut()).add(key, cause, count)
        return found

    def nulled(self) -> dict[str, list[str]]:
        """Return texts by session: for each column, how many values are null because they had another type.

        Only topics for which a question has asked so far are counted.
        """
        found: dict[str, list[str]] = {}
        for cast in self._casts:
            with suppress(self._duckdb.Error):  # its files were deleted after the question
                for session, count in self._database.execute(cast.count()).fetchall():
                    words = f"{count} of {cast.topic} {cast.column}: not {cast.kind}"
                    found.setdefault(session, []).append(printable_lines(words))
        return found

    def close(self) -> None:
        """Close the database, which frees its memory."""
        self._database.close()

    def _add_view(self, topic: Topic) -> None:
        name = view_name(topic.name)
        empty = f"empty_{name}"
        self._database.register(empty, _empty(topic))
        ours = self._columns(f'"{empty}"')
        # Files are grouped by their columns. If a column has another type in a file, its value is converted, or null if
        # that fails. A column that only other versions have becomes text.
        groups: dict[tuple[tuple[str, str], ...], list[str]] = {}
        for cached in self.sessions:
            for file in cached.files(topic.message):
                same = not cached.is_foreign(file)
                columns = ours if same else self._columns(f"read_parquet([{_text(str(file))}])")
                groups.setdefault(tuple(columns.items()), []).append(str(file))
        others = {column for group in groups for column, _ in group} - ours.keys()
        titles = _titles([*ours, *sorted(others)])
        blank = ", ".join(f"{_quoted(column)} AS {_quoted(titles[column])}" for column in ours)
        parts = [f'SELECT NULL::VARCHAR AS session, {blank} FROM "{empty}"']  # noqa: S608 - all is quoted
        for group, files in groups.items():
            there = dict(group)
            chosen = [_column(column, kind, there.get(column), titles[column]) for column, kind in ours.items()]
            self._casts += [
                _Cast(topic.name, column, kind, tuple(files))
                for column, kind in ours.items()
                if there.get(column, kind) != kind
            ]
            chosen += [
                f"CAST({_quoted(column)} AS VARCHAR) AS {_quoted(titles[column])}"
                for column in there.keys() - ours.keys()
            ]
            listed = ", ".join(map(_text, files))
            parts.append(
                f"SELECT {_SESSION} AS session, {', '.join(chosen)} "  # noqa: S608 - all is quoted
                f"FROM read_parquet([{listed}], filename=true)"
            )
        source = " UNION ALL BY NAME ".join(parts[1:] or parts)
        own = f"SELECT * FROM ({source}) WHERE {_is_of(topic.name)}"  # noqa: S608 - quoted
        self._database.execute(f'CREATE VIEW "{name}" AS {own}')

    def _columns(self, source: str) -> dict[str, str]:
        """Return the types of the columns."""
        found = self._database.execute(f"DESCRIBE FROM {source}").fetchall()
        return {name: kind for name, kind, *_ in found}

    def _add_context(self, topic: Topic) -> None:
        name = view_name(topic.name)
        columns, joins = ["r.*"], []
        for number, (other, added) in enumerate(CONTEXT):
            alias, stale_s = f"c{number}", TOPICS[other].stale_after_s
            fresh = "" if stale_s is None else f"r.publish_time - {alias}.publish_time <= INTERVAL {stale_s} SECOND"
            for title, expression in added:
                value = expression.format(c=alias)
                columns.append(f"CASE WHEN {fresh} THEN {value} END AS {title}" if fresh else f"{value} AS {title}")
            same = "" if other.startswith("@") else f" AND r.car = {alias}.car"
            joins.append(
                f'ASOF LEFT JOIN "{view_name(other)}" {alias} '
                f"ON r.session = {alias}.session{same} AND r.publish_time >= {alias}.publish_time"
            )
        joined = f'SELECT {", ".join(columns)} FROM "{name}" r {" ".join(joins)}'  # noqa: S608 - names of ours
        self._database.execute(f'CREATE VIEW "{name}_context" AS {joined}')


_FOLDERS: Final = r"([^/\\]+)[/\\][^/\\]+[/\\][^/\\]+$"
# The session is the directory above the directory of its tables. For a single file, this is a hidden directory beside
# it.
_SESSION: Final = f"regexp_replace(regexp_extract(filename, '{_FOLDERS}', 1), '^\\.(.*)$', '\\1')"


class _Cast(Struct, frozen=True):
    """A column that some files have with another type."""

    topic: str
    column: str
    kind: str
    """The type of the column in our tables."""
    files: tuple[str, ...]

    def count(self) -> str:
        """Return the SQL that counts, for each session, the values that cannot be converted to our type."""
        files, column = ", ".join(map(_text, self.files)), _quoted(self.column)
        return (
            f"SELECT {_SESSION}, count(*) FROM read_parquet([{files}], filename=true) "  # noqa: S608 - quoted
            f"WHERE {_is_of(self.topic)} AND {column} IS NOT NULL AND TRY_CAST({column} AS {self.kind}) IS NULL "
            "GROUP BY 1 ORDER BY 1"
        )


def _is_of(topic: str) -> str:
    """Return the condition that a row is of this topic.

    It is needed because several topics may share a message type.
    """
    return f"key LIKE {_text('%/' + topic)}"


def view_name(topic: str) -> str:
    """Return the name of a topic's view: `sensor_range`, `coordinator_plan`."""
    return topic.replace("@", "").replace("/", "_")


def _empty(topic: Topic) -> "pa.Table":
    return ArrowSink(Layout(messages.message_class(topic.message).DESCRIPTOR).columns, "us").table()


def _titles(columns: Iterable[str]) -> dict[str, str]:
    """Return the name in a view of each column of its files: such as `session_1`, because `session` is the view's own.

    DuckDB ignores case in names, and cannot unite files in which two columns have one name.
    """
    taken = {"session"}
    titles: dict[str, str] = {}
    for column in columns:
        free = chain([column], (f"{column}_{number}" for number in count(1)))
        title = titles[column] = next(name for name in free if name.lower() not in taken)
        taken.add(title.lower())
    return titles


def _column(name: str, kind: str, there: str | None, title: str) -> str:
    """Return the expression of a column of ours. `there` is its type in the files, or None if they lack it."""
    quoted = _quoted(name)
    value = f"NULL::{kind}" if there is None else quoted if there == kind else f"TRY_CAST({quoted} AS {kind})"
    return f"{value} AS {_quoted(title)}"


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


def _text(value: str) -> str:
    return "'" + value.replace("'", "''") + "'"


def _is_gone(error: Exception) -> bool:
    return "No such file" in str(error) or "No files found" in str(error)


def _no_table(text: str) -> str:
    """Return what DuckDB says about a missing table with the likely name. Empty if it says something else.

    DuckDB's own suggestion is wrong, because it knows only the views that questions have named so far.
    """
    missing = _NO_TABLE.search(text)
    if missing is None:
        return ""
    views = [view_name(topic.name) for topic in TOPICS.values()]
    contexts = [f"{view_name(topic.name)}_context" for topic in TOPICS.values() if topic.family == "sensor"]
    near = did_you_mean(missing[1], [*views, *contexts])
    words = f"There is no table {missing[1]}. {near or '`fleet query --tables` lists all.'}"
    return printable_lines(words)


def _one_line(text: str) -> str:
    """Return DuckDB's message as one line. Leave out the lines that show a position in the question."""
    lines: Iterable[str] = (line.strip() for line in text.splitlines())
    return printable_lines(" ".join(line for line in lines if line and not line.startswith(("^", "LINE"))))
