"""Kills the hub or the recorder at random moments under load, and checks that the recording is complete."""

import random
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import pytest

from fleet.recording.reading.session import NoSession, Session
from fleet.recording.tools.merge_cut_recover import recover
from fleet.recording.tools.verify import verify
from schemas.bus import BusError
from tests.support.processes import FleetProcesses, wait_for
from tests.support.recording import RATE_HZ, Load, Recording, faults, kill_hub, numbers

SECOND_S = 1.0
LONGEST_S = 4.0
"""Maximum time until a recorder is killed. A recorder that is killed at once has only a session's name."""
SLACK_S = 0.75
"""Maximum delay of a flush."""
GATHER_S = 0.25
"""Time from the recorder's first line until all publishers have its subscription."""


@dataclass(frozen=True, slots=True)
class Told:
    """Figures of one run."""

    published: int
    recovered: int
    """Number of messages that were missed at first and backfilled."""
    missing_s: tuple[float, ...] = ()
    """Time from the first message that an interrupted session lacks to the kill of its recorder."""


def hub_killed(
    fleet: FleetProcesses, out: Path, *, cars: int, times: int, chance: random.Random, rate_hz: float = RATE_HZ
) -> Told:
    """Kill the hub `times` times. Check that no message is lost or recorded twice, nor reported as such."""
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
    """Wait until every publisher is back at the hub, so that each can answer the recorder's backfill."""

    def answering() -> int:
        try:
            return len({str(sample.key_expr) for sample in fleet.bus.recall("fleet/*/sensor/line", 1.0)})
        except BusError:  # there is no new hub yet, or it does not answer yet
            return 0

    wait_for(lambda: answering() == cars, "all back")
    time.sleep(2 * SECOND_S)  # the recorder sends its last backfill query some seconds after a hub is back


def all_there(load: Load, sessions: list[Path]) -> None:
    """Wait until the sessions hold all messages of a load. At its own end, a recorder waits only for a moment."""
    wait_for(lambda: not faults(load, sessions)[0], "all that was published is recorded")


def ends_whole(fleet: FleetProcesses, load: Load, cars: int, recording: Recording, sessions: list[Path]) -> None:
    """End a load and its recording. Check that no message is lost or recorded twice, nor reported as such."""
    fleet_back(fleet, cars)
    load.rest()
    all_there(load, sessions)
    last = recording.end()
    assert (last["drops"], last["missed"]) == ({}, {})
    assert faults(load, sessions) == ({}, {})


def recorder_killed(
    fleet: FleetProcesses, out: Path, *, cars: int, times: int, chance: random.Random, slack_s: float = SLACK_S
) -> Told:
    """Kill the recorder `times` times, and start the next one each time.

    A session lacks at most the messages of the second before the kill. It reports them, and the next session has them.
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
        # The session has every message from its start to its last message. If the kill interrupted a backfill,
        # messages from before the start may be missing. `verify` names exactly these.
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
        # Compare with the published messages, not with the last recorded one: a publisher may have stalled, too.
        missing_s.append((at_ns - min(lacking_ns)) / 1e9)
        assert missing_s[-1] < SECOND_S + slack_s
        recovered = path.with_name(path.name + "-recovered")
        if verdict.messages:
            rescued, _ = recover(session, recovered)
            assert rescued == verdict.messages
            assert not verify(Session(recovered)).damage
        else:  # the session's first second was not over
            with pytest.raises(NoSession):
                recover(session, recovered)
        following = Session(sessions[number + 1]).description
        assert following is not None
        assert following.continues == path.name
    return Told(load.count(), 0, tuple(missing_s))
