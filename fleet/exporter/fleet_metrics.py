"""The newest messages of a fleet, and the values of its metrics. Pure: time is an argument."""

from collections import Counter
from collections.abc import Iterator
from typing import Any, Final

from fleet.coordinator.observer import FleetObserver
from fleet.exporter.metrics import CAR_METRICS, COMMANDS, OTHER, REFUSALS, Metric, recorder_values
from schemas import keys, messages, topics
from schemas.bus import Sample
from schemas.commands import COMMANDS as VERBS
from schemas.words import Phase, Reason

STATUS: Final = f"{keys.RECORDER}/status"
EVENTS: Final = "event/command"
MAX_EXPORTED_CARS: Final = 256
"""Maximum number of cars with metrics. If there are more, only the first by name have metrics. Each car has about
forty series, and one more for each kind of command and refusal. Anybody on an open bus may invent cars. The fleet file
of a whole hall has some dozens of cars."""
MAX_RECENT_RECORDS: Final = 4096
"""Maximum number of remembered records of commands. They are remembered so that each phase counts once: if a car cannot
show the effect of a command, the command ends with a second `sent`: a stop some 23 s later at most
(schemas.limits.MAX_EVIDENCE_TIMEOUT_S and its worst case), a drive at its end. The number is enough for 170 records a
second, and a stop has at least two."""
_REFUSALS: Final = frozenset({Phase.EXPIRED, Phase.FAILED, Phase.REJECTED})

Sampled = tuple[Metric, tuple[str, ...], float]
"""A metric, the values of its labels, and its value."""


class FleetMetrics:
    """The metrics of one fleet. Times are in s, of one clock that the caller chooses."""

    def __init__(self) -> None:
        self.observer = FleetObserver()
        self._commands: Counter[tuple[str, str, str]] = Counter()
        self._refusals: Counter[tuple[str, str]] = Counter()
        self._recent: dict[tuple[str, str, str], None] = {}
        """Cars, ids and phases of the newest records, the oldest first."""
        self._recorder: Any = None
        self._recorder_at = 0.0

    def on_sample(self, sample: Sample, now: float, wall_s: float | None = None) -> None:
        """Handle a message.

        `wall_s` is the wall clock if a query returned the message, which may then be old. Otherwise it is None.
        """
        key = keys.parse(sample.key)
        if key is None:
            return
        if key.topic == EVENTS:
            self._on_event(key.car, sample)
        elif f"{key.car}/{key.topic}" == STATUS:
            if (status := _parsed(STATUS, sample)) is not None:
                self._recorder, self._recorder_at = status, now
        else:
            self.observer.on_sample(sample, now, wall_s)

    def forget(self, now: float) -> None:
        """Forget cars whose gateways have been gone for a long time, and the commands of these cars."""
        self.observer.forget(now, ())
        for counter in (self._commands, self._refusals):
            for labels in [each for each in counter if each[0] not in self.observer.states]:
                del counter[labels]

    def values(self, now: float, *, sees_gateways: bool = True) -> Iterator[Sampled]:
        """Yield all values.

        `sees_gateways` is False while the link to the hub is lost, and while tokens may be missing after it is back. A
        gateway that is not seen then may be there, so its car has no metrics.
        """
        cars = sorted(self.observer.snapshot(()).cars)[:MAX_EXPORTED_CARS]
        for name in cars:
            if (state := self.observer.states.get(name)) is None:
                continue
            for metric in CAR_METRICS:
                if state.present or (metric.of_absent and sees_gateways):
                    for labels, value in metric.values(state, now):
                        yield metric, (name, *labels), value
        for command, count in sorted(self._commands.items()):
            if command[0] in cars:
                yield COMMANDS, command, count
        for refusal, count in sorted(self._refusals.items()):
            if refusal[0] in cars:
                yield REFUSALS, refusal, count
        stale_after_s = topics.TOPICS[STATUS].stale_after_s or 0.0
        if self._recorder is not None and now - self._recorder_at <= stale_after_s:
            for of_recorder, values in recorder_values(self._recorder):
                for labels, value in values:
                    yield of_recorder, labels, value

    def _on_event(self, car: str, sample: Sample) -> None:
        if car not in self.observer.states:  # anybody may publish for a name that is not a car
            return
        event = _parsed(EVENTS, sample)
        record = ("", "", "") if event is None else (car, event.id, event.phase)
        if record[2] not in tuple(Phase) or record in self._recent:
            return
        self._recent[record] = None
        if len(self._recent) > MAX_RECENT_RECORDS:
            del self._recent[next(iter(self._recent))]
        count = max(1, event.count)
        self._commands[car, event.verb if event.verb in VERBS else OTHER, event.phase] += count
        if event.phase in _REFUSALS:
            self._refusals[car, event.reason if event.reason in tuple(Reason) else OTHER] += count


def _parsed(topic: str, sample: Sample) -> Any:
    """Return the message of a sample, or None if this version cannot decode it."""
    try:
        return messages.parse(topics.TOPICS[topic].message, sample.payload, sample.encoding)
    except messages.BadPayload:
        return None
