"""Finds what is odd in a session: damage, gaps, stops, refused commands and broken links. Pure."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from typing import Any, Final

from fleet.client.diagnosis import DoctorFinding
from fleet.recording.reading.mcap_reader import Row
from fleet.recording.reading.message_decoder import MessageDecoder
from fleet.recording.tools.verify import SessionVerdict
from schemas import keys
from schemas.commands import STOPS

_REFUSED_PHASES: Final = ("rejected", "failed")
_TOPICS: Final = ("event/command", "event/log")


@dataclass(slots=True)
class SessionCheckup:
    """Counts of one session, by car."""

    stops: Counter[str] = field(default_factory=Counter)
    """Ended stops by `shown`, `sent` or `failed`."""
    unshown: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    """Refused commands by reason."""
    broken: Counter[str] = field(default_factory=Counter)
    """Lost links."""
    left_moving: set[str] = field(default_factory=set)
    """Cars whose gateway ended before they had shown their stop."""
    _decoder: MessageDecoder = field(default_factory=MessageDecoder)

    def watch(self, rows: Iterable[Row]) -> Iterator[Row]:
        """Pass on rows and count what they are."""
        for row in rows:
            info, _, _, _, data = row
            key = keys.parse(info.channel.topic)
            if key is not None and key.topic in _TOPICS:
                message = self._decoder.message(info, data)
                if message is not None:
                    self.add(key.car, key.topic, message)
            yield row

    def add(self, car: str, topic: str, message: Any) -> None:
        """Count one message."""
        if topic == "event/log":
            code = message.name.partition("/")[2]
            self.unshown[car] += code == "not_shown"
            self.broken[car] += code == "link_lost"
            if code == "not_stopped":
                self.left_moving.add(car)
            return
        if message.verb in STOPS and (message.basis or message.phase == "failed"):
            self.stops[message.basis or "failed"] += 1
        if message.phase in _REFUSED_PHASES:
            self.refused[message.reason or message.phase] += 1

    def findings(self, verdict: SessionVerdict, name: str) -> Iterator[DoctorFinding]:
        """Yield what is odd, the most important first. name: of the session, as one types it."""
        replay, verify = f"fleet replay {name}", f"fleet sessions verify {name}"
        if self.left_moving:
            cars = ", ".join(sorted(self.left_moving))
            yield DoctorFinding("not_stopped", f"{cars}: the gateway ended before the car had shown its stop.", replay)
        if cars := _most(self.unshown):
            yield DoctorFinding("not_shown", f"Stops that the car could have shown and did not: {cars}.", replay)
        if verdict.damage:
            words = "; ".join(f"{file} {why}" for file, why in verdict.damage.items())
            yield DoctorFinding("damage", f"Damaged: {words}.", f"fleet sessions recover {name}")
        if verdict.ended:
            yield DoctorFinding("not_closed", f"{verdict.ended[0].upper()}{verdict.ended[1:]}.", verify)
        if lost := sum(verdict.dropped.values()):
            yield DoctorFinding(
                "recorder_drops", f"The recorder dropped {lost} messages: its disk was too slow.", verify
            )
        if verdict.missing_count:
            worst = max(verdict.missing, key=lambda gap: gap["count"])
            words = f"{verdict.missing_count} messages are missing, most at once of {worst['key']} ({worst['count']})."
            yield DoctorFinding("gaps", words, verify)
        if cars := _most(self.broken):
            yield DoctorFinding("link_breaks", f"Links broke: {cars}.", replay)
        if reasons := _most(self.refused):
            yield DoctorFinding("refused", f"Commands were refused or failed: {reasons}.", replay)

    def facts(self, verdict: SessionVerdict) -> Iterator[tuple[str, str]]:
        """Yield what is known of the session, as names and texts."""
        yield "state", f"{'whole' if verdict.whole else 'not whole'}, {verdict.messages} messages"
        lost = sum(verdict.dropped.values()) + sum(verdict.missed.values())
        yield "lost", f"{verdict.missing_count} missing by number, {lost} by the recorder's count"
        yield "stops", ", ".join(f"{self.stops[basis]} {basis}" for basis in ("shown", "sent", "failed"))
        yield "refused", _most(self.refused) or "none"
        yield "links lost", _most(self.broken) or "none"
        steps = len(verdict.backwards) + sum(clock.backwards for clock in verdict.clocks.values())
        yield "clock steps", str(steps)

    def as_dict(self, verdict: SessionVerdict, name: str) -> dict[str, Any]:
        """Return the findings and what is known, for JSON."""
        found = [asdict(finding) for finding in self.findings(verdict, name)]
        return {"session": verdict.session, "findings": found, "facts": dict(self.facts(verdict))}


def _most(counts: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.most_common() if count)
