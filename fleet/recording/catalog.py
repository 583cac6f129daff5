"""Answers SQL questions to all recorded sessions: DuckDB over the tables of each, with one view for each topic.

`sensor_range` has the messages of `sensor/range` of every car in every session, with the columns of
`fleet sessions export` and the name of the `session`. `sensor_range_context` adds what was true at that time: the mode
as commanded and as seen, the motion, who drove, and the phase of the plan. Topics without a message have views, too.
"""

from collections.abc import Callable, Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from fleet.recording.reading.session import NoSession
from fleet.recording.session_lookup import sessions_in, sessions_place
from fleet.recording.tools.table_cache import CachedTables, tables_of
from fleet.recording.tools.table_formats import ArrowSink, FormatMissing, import_pyarrow
from fleet.recording.tools.tables import Layout
from schemas import messages
from schemas.topics import TOPICS, Topic

if TYPE_CHECKING:
    import pyarrow as pa  # type: ignore[import-untyped]  # it has no stubs

MEMORY_LIMIT: Final = "1GB"
"""Maximum memory of a question. DuckDB writes to a temporary directory beyond it."""
CONTEXT: Final[tuple[tuple[str, tuple[tuple[str, str], ...]], ...]] = (
    ("state/mode", (("mode", "{c}.asked"), ("mode_seen", "{c}.inferred"), ("verdict", "{c}.verdict"))),
    ("state/motion", (("motion", "{c}.motion"), ("owner", "{c}.owner"))),
    ("state/safety", (("motors", "{c}.motors"), ("driver", "json_extract_string({c}.lease, '$.holder')"))),
    ("@coordinator/assignment", (("plan_phase", "{c}.phase"), ("plan_version", "{c}.plan_version"))),
)
"""What `..._context` adds: topic, and for each column its expression. `{c}` is the row of the topic."""


class BadQuery(ValueError):
    """A question that cannot be answered. The text is that of DuckDB, on one line."""


class Catalog:
    """All sessions of a directory. Raises FormatMissing without DuckDB; `damage` has what could not be read."""

    def __init__(
        self,
        directory: str | PathLike[str] | None = None,
        *,
        on_session: Callable[[Path], None] | None = None,
    ) -> None:
        """`directory`: None for `sessions` here. `on_session`: called for each session that is looked at."""
        try:
            import duckdb
        except ImportError:
            raise FormatMissing("duckdb") from None
        self._duckdb = duckdb
        self.directory = Path(directory) if directory is not None else sessions_place()
        self.damage: dict[str, str] = {}
        """By name of a session, what of it could not be read."""
        self.sessions: list[CachedTables] = []
        self._on_session = on_session
        self._find()

    def _find(self) -> None:
        """Look for the sessions, and define the views anew."""
        self.damage.clear()
        self.sessions.clear()
        for path in sorted(sessions_in(self.directory)):
            if self._on_session is not None:
                self._on_session(path)
            try:
                cached = tables_of(path)
            except (NoSession, OSError) as error:
                self.damage[path.name] = str(error)
                continue
            self.sessions.append(cached)
            if cached.words:
                self.damage[path.name] = cached.words
        self._database = self._duckdb.connect(config={"memory_limit": MEMORY_LIMIT})
        self._database.execute("SET TimeZone = 'UTC'")
        for topic in TOPICS.values():
            self._add_view(topic)
        for topic in TOPICS.values():
            if topic.family == "sensor":
                self._add_context(topic)

    def tables(self) -> dict[str, list[str]]:
        """Return the columns of each view, by its name."""
        found = self._database.execute(
            "SELECT table_name, column_name FROM information_schema.columns "
            "WHERE table_name NOT LIKE 'empty_%' ORDER BY table_name, ordinal_position"
        ).fetchall()
        columns: dict[str, list[str]] = {}
        for table, column in found:
            columns.setdefault(table, []).append(column)
        return columns

    def query(self, sql: str, parameters: Sequence[Any] = ()) -> "pa.Table":
        """Return the answer to a question as a pyarrow.Table. Raises BadQuery."""
        try:
            return self._answer(sql, parameters)
        except self._duckdb.Error as error:
            if not _is_gone(error):
                raise BadQuery(_one_line(str(error))) from None
        self._find()  # the quota has deleted a session meanwhile, or its tables
        try:
            return self._answer(sql, parameters)
        except self._duckdb.Error as error:
            raise BadQuery(_one_line(str(error))) from None

    def _answer(self, sql: str, parameters: Sequence[Any]) -> "pa.Table":
        answer: Any = self._database.sql(sql, params=list(parameters) or None)
        return import_pyarrow().table({}) if answer is None else answer.to_arrow_table()

    def close(self) -> None:
        """Free the memory."""
        self._database.close()

    def _add_view(self, topic: Topic) -> None:
        name = view_name(topic.name)
        files = [str(each) for cached in self.sessions for each in cached.files(topic.message)]
        if not files:
            empty = f"empty_{name}"
            self._database.register(empty, _empty(topic))
            source = f'SELECT NULL::VARCHAR AS session, * FROM "{empty}"'  # noqa: S608 - a name of ours
        else:
            listed = ", ".join(_text(each) for each in files)
            # The session is the directory above that of its tables.
            session = "regexp_extract(filename, '([^/\\\\]+)[/\\\\][^/\\\\]+[/\\\\][^/\\\\]+$', 1)"
            read = f"read_parquet([{listed}], union_by_name=true, filename=true)"
            source = f"SELECT {session} AS session, * EXCLUDE (filename) FROM {read}"  # noqa: S608 - quoted above
        # Several topics may share a message.
        own = f"SELECT * FROM ({source}) WHERE key LIKE {_text('%/' + topic.name)}"  # noqa: S608 - quoted
        self._database.execute(f'CREATE VIEW "{name}" AS {own}')

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


def view_name(topic: str) -> str:
    """Return the name of a topic's view: `sensor_range`, `coordinator_plan`."""
    return topic.replace("@", "").replace("/", "_")


def _empty(topic: Topic) -> "pa.Table":
    return ArrowSink(Layout(messages.message_class(topic.message).DESCRIPTOR).columns, "us").table()


def _text(value: str) -> str:
    return "'" + value.replace("'", "''") + "'"


def _is_gone(error: Exception) -> bool:
    return "No such file" in str(error) or "No files found" in str(error)


def _one_line(text: str) -> str:
    """Return the message of DuckDB without the picture of the place."""
    lines: Iterable[str] = (line.strip() for line in text.splitlines())
    return " ".join(line for line in lines if line and not line.startswith(("^", "LINE")))
