"""Reads sessions for the time line, in a process of its own (worker.py). The process runs this module.

It caches nothing: each jump reads the chunks around the moment again. So memory stays the same however long a session
is, and a session that grows, or that loses files to the quota, is read as it is now.
"""

from pathlib import Path
from typing import Any, Final

from fleet.console.map_view import PLACE_TOPICS, TRAIL_S, TRAIL_STEP_S
from fleet.console.past_view import (
    DECISIONS_BEFORE_NS,
    DETAIL_BEFORE_NS,
    cars_at,
    detail_of,
    lanes_as_dict,
    map_at,
    plan_at,
    samples_of,
)
from fleet.console.plot_buffer import Series
from fleet.console.worker import serve_lines
from fleet.recording.reading.session import NoSession, Session
from fleet.recording.tools.car_timeline import DECISION_TOPIC
from fleet.recording.tools.moment import known_at, lanes_of, newest_of, read_between, thinned
from fleet.recording.tools.summary import of_session
from schemas.topics import TOPICS

PLAN: Final = TOPICS["@coordinator/plan"]
ASSIGNMENT: Final = TOPICS["@coordinator/assignment"]
_MS: Final = 1_000_000


def answer(question: dict[str, Any]) -> dict[str, Any]:
    """Return the lanes of a session, or, with `at_ms`, the state at that moment.

    `ok` is False if the session cannot be read.
    """
    try:
        session = Session(Path(question["path"]))
    except NoSession as error:
        return {"ok": False, "words": str(error)}
    at_ms = question.get("at_ms")
    found = _lanes(session) if at_ms is None else _moment(session, at_ms * _MS, question)
    # A session that is still being written always ends in the middle of a file.
    damage = "; ".join(words for path, words in sorted(session.damage.items()) if path not in session.unended)
    return {"ok": True, "words": damage} | found


def _lanes(session: Session) -> dict[str, Any]:
    about = of_session(session)
    found = lanes_as_dict(lanes_of(session), about.end_ns)
    return found | {"begin_ms": about.start_ns // _MS, "end_ms": about.end_ns // _MS, "cars": list(about.cars)}


def _moment(session: Session, at_ns: int, question: dict[str, Any]) -> dict[str, Any]:
    known = known_at(session, at_ns)
    found: dict[str, Any] = {"cars": cars_at(known, at_ns, question["colors"])}
    if car := question["car"]:
        names = ("frame/rx", "frame/tx", "event/command", "event/log")
        topics = tuple(f"*/{car}/{name}" for name in names)
        messages = read_between(session, topics, at_ns - DETAIL_BEFORE_NS, at_ns)
        found["detail"] = detail_of(car, messages, known, at_ns)
    if series := [Series(*each) for each in question["series"]]:
        from_ns = at_ns - round(question["span_s"] * 1e9)
        topics = tuple(dict.fromkeys(f"*/{each.car}/{each.topic}" for each in series))
        found["samples"] = samples_of(series, read_between(session, topics, from_ns, at_ns), from_ns, at_ns)
    if question.get("map"):
        topics = tuple(f"*/*/{topic}" for topic in PLACE_TOPICS)
        trail = thinned(session, topics, at_ns - round(TRAIL_S * 1e9), at_ns, round(TRAIL_STEP_S * 1e9))
        found["map"] = map_at(known, trail, at_ns)
    if question.get("plan"):
        in_force = newest_of(session, (f"*/{PLAN.name}", f"*/{ASSIGNMENT.name}"), at_ns)
        decisions = read_between(session, (f"*/{DECISION_TOPIC}",), at_ns - DECISIONS_BEFORE_NS, at_ns)
        found["plan"] = plan_at(in_force, decisions)
    return found


if __name__ == "__main__":
    serve_lines(answer)
