"""Finds what is odd in a session: damage, gaps, stops, refused commands and broken links. Pure."""

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any, Final

from msgspec import Struct, field, to_builtins

from fleet.client.diagnosis import DoctorFinding
from fleet.recording.reading.mcap_reader import Row
from fleet.recording.stop_count import stops_cars
from fleet.recording.tools.moment import known_message
from fleet.recording.tools.recorder_clock import RecorderClock
from fleet.recording.tools.stop_findings import (
    NOT_SHOWN_CODE,
    NOT_STOPPED_CODE,
    WATCHED_TOPICS,
    StopFindings,
    log_code,
)
from fleet.recording.tools.verify import SessionVerdict
from schemas import keys
from schemas.local_time import clock
from schemas.words import Basis, Phase

_NOT_CARRIED_OUT_PHASES: Final = (Phase.REJECTED, Phase.FAILED)


class SessionCheckup(Struct):
    """Counts of one session."""

    stops: Counter[str] = field(default_factory=Counter)
    """How many stops ended as `shown`, `sent` and `failed`."""
    unshown: StopFindings = field(default_factory=StopFindings)
    """Stops that a car did not show, or that did not stop it."""
    refused: Counter[str] = field(default_factory=Counter)
    """Refused and failed commands by reason, except stops."""
    broken: Counter[str] = field(default_factory=Counter)
    """Lost links by car."""
    car: str = ""
    """The only car to look at. Empty for all cars."""
    cars: set[str] = field(default_factory=set)
    """The cars of the session."""
    _clock: RecorderClock = field(default_factory=RecorderClock)

    def watch(self, rows: Iterable[Row]) -> Iterator[Row]:
        """Pass all rows on, and count what matters in them."""
        for row in rows:
            key = keys.parse(row[0].channel.topic)
            if key is not None and not key.car.startswith("@"):
                self.cars.add(key.car)
            if key is not None and key.topic in WATCHED_TOPICS and self.car in ("", key.car):
                known = known_message(row)
                if known is not None:
                    self.add(key.car, key.topic, known.message, self._clock.time_ns(known))
            yield row

    def add(self, car: str, topic: str, message: Any, at_ns: int) -> None:
        """Count one message. `at_ns` is its time by the recorder's clock."""
        self.unshown.add(car, topic, message, at_ns)
        if topic == "event/log":
            self.broken[car] += log_code(message) == "link_lost"
        elif topic == "event/command":
            is_stop = stops_cars(message)
            if is_stop and (message.basis or message.phase == Phase.FAILED):
                self.stops[message.basis or Phase.FAILED] += 1
            if message.phase in _NOT_CARRIED_OUT_PHASES and not is_stop:
                self.refused[message.reason or message.phase] += 1

    def findings(self, verdict: SessionVerdict, name: str) -> Iterator[DoctorFinding]:
        """Yield the findings, the most important first. `name` is the name of the session, as a user types it."""
        replay, verify = f"fleet replay {name}", f"fleet sessions verify {name}"
        for code in (NOT_STOPPED_CODE, NOT_SHOWN_CODE):
            if stops := self.unshown.of(code):
                first, more = stops[0], len(stops) - 1
                words = first.describe() + (f" And {more} more like it." if more else "")
                at = clock(first.at_ns / 1e9).partition(" ")[0]
                yield DoctorFinding(code, words, f"fleet why {first.car} --at {at} --session {name}")
        if verdict.damage:
            words = "; ".join(f"{file} {why}" for file, why in verdict.damage.items())
            yield DoctorFinding("damage", f"Damaged: {words}.", f"fleet sessions recover {name}")
        if verdict.ended:
            yield DoctorFinding("not_closed", f"{verdict.ended[0].upper()}{verdict.ended[1:]}.", verify)
        if dropped := sum(verdict.dropped.values()):
            yield DoctorFinding(
                "recorder_drops", f"The recorder dropped {dropped} messages: its disk was full or too slow.", verify
            )
        if verdict.missing_count:
            worst = max(verdict.missing, key=lambda gap: gap["count"])
            words = f"{verdict.missing_count} messages are missing. Largest gap: {worst['count']} of {worst['key']}."
            yield DoctorFinding("gaps", words, verify)
        elif missed := sum(verdict.missed.values()):
            worst_key = max(verdict.missed, key=verdict.missed.__getitem__)
            words = f"By the recorder's count, {missed} messages never came, most of them of {worst_key}."
            yield DoctorFinding("gaps", words, verify)
        if cars := _describe(self.broken):
            yield DoctorFinding("link_breaks", f"Links broke: {cars}.", replay)
        if reasons := _describe(self.refused):
            yield DoctorFinding("refused", f"Commands were refused or failed: {reasons}.", replay)

    def facts(self, verdict: SessionVerdict) -> Iterator[tuple[str, str]]:
        """Yield the facts known about the session, as names and texts."""
        yield "state", f"{'whole' if verdict.whole else 'not whole'}, {verdict.messages} messages"
        lost = sum(verdict.dropped.values()) + sum(verdict.missed.values())
        yield "lost", f"{verdict.missing_count} by their sequence numbers, {lost} by the recorder's count"
        yield "stops", ", ".join(f"{self.stops[basis]} {basis}" for basis in (*Basis, Phase.FAILED))
        yield "refused", _describe(self.refused) or "none"
        yield "links lost", _describe(self.broken) or "none"
        steps = len(verdict.backwards) + sum(each.backwards for each in verdict.clocks.values())
        yield "clock steps", str(steps)

    def as_dict(self, verdict: SessionVerdict, name: str) -> dict[str, Any]:
        """Return the findings and the facts, for JSON."""
        found = [to_builtins(finding) for finding in self.findings(verdict, name)]
        stops = [each.as_dict() for each in self.unshown.stops]
        return {"session": verdict.session, "findings": found, "facts": dict(self.facts(verdict)), "stops": stops}


def _describe(counts: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.most_common() if count)
