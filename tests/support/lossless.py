"""What a recording must hold whoever is killed meanwhile, at random moments and under load."""

import random
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import pytest

from fleet.recording.reading.session import NoSession, Session
from fleet.recording.tools.transform import recover
from fleet.recording.tools.verify import verify
from schemas.bus import BusError
from tests.support.processes import FleetProcesses, wait_for
from tests.support.recording import RATE_HZ, Load, Recording, faults, kill_hub, numbers

SECOND_S = 1.0
LONGEST_S = 4.0
"""Until a recorder is killed; at once, it may have nothing but a name."""
SLACK_S = 0.75
"""What a flush that is due may be late."""
GATHER_S = 0.25
"""From when it says that it records until all publishers know of it."""


@dataclass(frozen=True, slots=True)
class Told:
    """Figures of one run."""

    published: int
    recovered: int
    """Missed at first and had again."""
    missing_s: tuple[float, ...] = ()
    """Of each session that was cut off: how long before the kill it ends."""


def hub_killed(
    fleet: FleetProcesses, out: Path, *, cars: int, times: int, chance: random.Random, rate_hz: float = RATE_HZ
) -> Told:
    """Kill the hub so often: nothing is lost, nothing is there twice, and nothing is said to be."""
    recording = Recording(fleet, out)
    with Load(fleet.endpoint, cars, rate_hz) as load:
        wait_for(lambda: load.count() > 4 * cars, "a load")
        for _ in range(times):
            kill_hub(fleet, chance)
        running = {key: len(sent) for key, sent in load.sent.items()}
        wait_for(lambda: all(len(load.sent[key]) > count for key, count in running.items()), "all are publishing")
        ends_whole(fleet, load, cars, recording, [recording.session])
    verdict = verify(Session(recording.session))
    assert verdict.whole, list(verdict.words())
    description = Session(recording.session).description
    assert description is not None
    return Told(load.count(), sum(description.recovered.values()))


def fleet_back(fleet: FleetProcesses, cars: int) -> None:
    """Wait until every publisher is back at the hub: who answers holds what the recorder still asks for."""

    def answering() -> int:
        try:
            return len({str(sample.key_expr) for sample in fleet.bus.recall("fleet/*/sensor/line", 1.0)})
        except BusError:  # nobody has started the next hub yet, or it does not answer yet
            return 0

    wait_for(lambda: answering() == cars, "all back")
    time.sleep(2 * SECOND_S)  # the recorder asks for the last time some seconds after a hub is back


def all_there(load: Load, sessions: list[Path]) -> None:
    """Wait until the sessions hold all that a load published: a recorder at its end waits only for a moment."""
    wait_for(lambda: not faults(load, sessions)[0], "all that was published is recorded")


def ends_whole(fleet: FleetProcesses, load: Load, cars: int, recording: Recording, sessions: list[Path]) -> None:
    """End a load, and then its recording: nothing is lost, nothing is there twice, and nothing is said to be."""
    fleet_back(fleet, cars)
    load.rest()
    all_there(load, sessions)
    last = recording.end()
    assert (last["drops"], last["missed"]) == ({}, {})
    assert faults(load, sessions) == ({}, {})


def recorder_killed(
    fleet: FleetProcesses, out: Path, *, cars: int, times: int, chance: random.Random, slack_s: float = SLACK_S
) -> Told:
    """Kill the recorder so often, each time starting the next.

    Each session lacks what was published in the second before its kill at most, and says so; the next one has it.
    """
    recording = Recording(fleet, out)
    sessions, recording_ns, killed_ns = [recording.session], [time.time_ns()], []
    with Load(fleet.endpoint, cars) as load:
        wait_for(lambda: load.count() > 4 * cars, "a load")
        for _ in range(times):
            time.sleep(LONGEST_S * chance.random())
            killed_ns.append(recording.process.kill())
            recording.process.wait()
            recording = Recording(fleet, out)
            sessions.append(recording.session)
            recording_ns.append(time.time_ns())
        ends_whole(fleet, load, cars, recording, sessions)
    missing_s = []
    for number, (path, at_ns) in enumerate(zip(sessions[:-1], killed_ns, strict=True)):
        session = Session(path)
        verdict = verify(session)
        words = list(verdict.words())
        assert not verdict.whole
        assert "it crashed" in verdict.ended, words
        assert (verdict.twice, verdict.missed, verdict.dropped) == ([], {}, {}), words
        # Everything from its beginning until then is here. Of what it had again from before it may lack some, if it
        # was killed meanwhile: that, verify says exactly.
        have = numbers([path])
        said = {(one["key"], number) for one in verdict.missing for number in range(one["first"], one["last"] + 1)}
        assert said == {
            (key, number)
            for key, there in have.items()
            for number in range(min(there), max(there))
            if not there[number]
        }, words
        begun_ns = recording_ns[number] + GATHER_S * 1e9
        lacking_ns = [at_ns]
        for key, sent in load.sent.items():
            there = have.get(key, Counter())
            lacks = [each for each, sent_ns in enumerate(sent, 1) if begun_ns < sent_ns < at_ns and each not in there]
            assert all(each > max(there, default=0) for each in lacks), (key, path)
            lacking_ns += [sent[each - 1] for each in lacks]
        # By what was published, not by the last that is there: who publishes may have been held up, too.
        missing_s.append((at_ns - min(lacking_ns)) / 1e9)
        assert missing_s[-1] < SECOND_S + slack_s
        recovered = path.with_name(path.name + "-recovered")
        if verdict.messages:
            rescued, _ = recover(session, recovered)
            assert rescued == verdict.messages
            assert not verify(Session(recovered)).damage
        else:  # its first second was not over yet
            with pytest.raises(NoSession):
                recover(session, recovered)
        following = Session(sessions[number + 1]).description
        assert following is not None
        assert following.continues == path.name
    return Told(load.count(), 0, tuple(missing_s))
