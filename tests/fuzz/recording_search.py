"""Searches for messages that a recorder loses without a word, or writes twice.

An episode has some publishers, the links between them and a recorder, and the recorder's session on a disk, on virtual
time. Links are lost for moments or for long, single messages are lost or late, publishers restart, clocks are wrong,
sessions roll over, and the recorder is killed and started again. The writer, its files, and the plan of a backfill are
the real ones. The files are read back at the end, and compared with what was published.
"""

import os
import random
from collections import Counter, deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

import zenoh

from fleet.quota import Quota
from fleet.recording.reading.session import Session
from fleet.recording.session_dir import SEGMENTS, SessionInfo
from fleet.recording.writing.backfill import BACKFILL_POLL_INTERVAL_S, LEASE_POLLS
from fleet.recording.writing.backfill_plan import EVERYTHING, BackfillPlan, PlannedQuery
from fleet.recording.writing.publisher_clocks import MIN_BEHIND_NS
from fleet.recording.writing.session_writer import Options, SessionWriter
from schemas.gen import fleet_v1_pb2 as pb
from schemas.messages import encoding_of

EPOCH_NS: Final = 1_790_000_000_000_000_000
ENCODING: Final = zenoh.Encoding(encoding_of("fleet.v1.Line"))
STEP_S: Final = 0.05
LEASE_S: Final = 2.0
AHEAD_S: Final = 0.5
"""Zenoh replaces the time of a message that is further ahead of the receiver's clock than this."""
END_S: Final = 8.0
"""Time at the end in which all links hold. Publishers that seldom publish say nothing in it."""


IN_TRANSIT_S: Final = 0.1
"""Time for which a message may be on its way when the recording ends."""


class VirtualStamp(NamedTuple):
    """A time stamp, as Zenoh has it."""

    ns: int

    def get_time_as_ntp64(self) -> "VirtualStamp":
        """Return the time."""
        return self

    def as_nanos(self) -> int:
        """Return the time, ns since the epoch."""
        return self.ns


class VirtualEntity(NamedTuple):
    """A publisher."""

    zid: str
    eid: int


class VirtualSource(NamedTuple):
    """The number of a message and its publisher."""

    source_id: VirtualEntity
    source_sn: int


class VirtualSample(NamedTuple):
    """A message as a recorder gets it."""

    key_expr: str
    payload: "VirtualPayload"
    encoding: zenoh.Encoding
    timestamp: VirtualStamp
    source_info: VirtualSource


class VirtualPayload(bytes):
    """A payload."""

    def to_bytes(self) -> bytes:
        """Return the bytes."""
        return self


@dataclass(slots=True)
class VirtualPublisher:
    """One publisher of a car."""

    key: str
    interval_s: float
    cache: deque[VirtualSample]
    due_at: float
    entity: VirtualEntity
    sent: int = 0


@dataclass(slots=True)
class PublishingCar:
    """A car whose gateway publishes."""

    name: str
    offset_s: float
    """How far its clock is ahead."""
    publishers: list[VirtualPublisher]
    life: int = 0
    linked: bool = True
    lost_at: float = 0.0
    back_at: float = 0.0
    on_way: list[tuple[float, VirtualSample]] = field(default_factory=list)
    """Live messages on their way to the recorder, in order."""


class RecordingEpisode:
    """One recorder and its publishers."""

    def __init__(self, seed: int, root: Path) -> None:
        self.moments = moments = random.Random(seed)
        self.root = root
        self.now = 0.0
        self.violations: list[str] = []
        self.story: list[str] = []
        self.published: dict[bytes, tuple[str, VirtualEntity, int, float]] = {}
        """By payload: the key, the publisher, the number, and when it was published."""
        self.lost_alone: set[tuple[str, VirtualEntity, int]] = set()
        """Messages that were lost on a link that was whole. Only a later message of the publisher shows that."""
        self.loss = moments.choice([0.0, 0.0, 0.01, 0.1])
        self.late = moments.choice([0.0, 0.0, 0.05])
        self.cars = [self._car(number) for number in range(moments.randint(1, 3))]
        self.recorder_linked = True
        self.recorder_lost_at = self.recorder_back_at = 0.0
        self.queue: list[VirtualSample] = []
        self.answers: list[tuple[float, PlannedQuery, list[VirtualSample], bool]] = []
        self.kills = 0
        self.rolls = moments.random() < 0.5
        self.quota = Quota(session=moments.choice([4000, 20_000]) if self.rolls else 0)
        self.paths: list[Path] = []
        self.known_since = 0.0
        """Since when everything is to be recorded: nobody asks for what is older than the last resumption allows. If a
        clock is a little behind, its messages look older than they are."""
        self.session: SessionWriter | None = None
        self.start()

    def _car(self, number: int) -> PublishingCar:
        moments = self.moments
        name = f"car{number}"
        offset_s = moments.choice([0.0, 0.0, 0.3, -0.4, -3600.0, 3600.0])
        intervals_s = [moments.choice([0.1, 0.5, 1.0])]  # a gateway publishes its states at least each second
        intervals_s += [moments.choice([0.1, 1.0, 20.0, 60.0]) for _ in range(moments.randint(0, 2))]
        publishers = [
            VirtualPublisher(
                f"fleet/{name}/sensor/t{index}",
                each,
                deque(maxlen=max(20, int(10 / each))),
                moments.random() * each,
                VirtualEntity(f"{name}-0", index),
            )
            for index, each in enumerate(intervals_s)
        ]
        return PublishingCar(name, offset_s, publishers)

    # ------------------------------------------------------------------ the recorder

    @property
    def now_ns(self) -> int:
        """The recorder's clock."""
        return EPOCH_NS + int(self.now * 1e9)

    def start(self, after: SessionWriter | None = None) -> None:
        """Begin a session."""
        self.session = SessionWriter(self.root, "fleet", Options(quota=self.quota), self.now_ns, after=after)
        self.paths.append(self.session.path)
        self.tell(f"session {self.session.path.name}, continues {self.session.description.continues!r}")
        if after is not None:
            return
        age_s = (self.now_ns - self.session.resume_since_ns) / 1e9
        self.known_since = max(self.known_since, self.now - age_s + MIN_BEHIND_NS / 1e9)
        since = self.now - age_s if self.session.description.continues else None
        self.plan = BackfillPlan(self.now, resume_since=since)
        self.polls = deque([self.now], LEASE_POLLS)
        self.connected_since = self.now
        self.link = self.recorder_back_at
        self.next_poll = self.now
        self.next_tick = self.now + 1.0
        self.gaps: dict[str, float] = {}
        self.newcomers: dict[str, str] = {}
        self.queue.clear()
        self.answers.clear()

    def kill(self) -> None:
        """Kill the recorder."""
        self.tell("killed")
        self.kills += 1
        assert self.session is not None
        if self.session._segment is not None:
            self.session._segment.cut()
        self.session = None

    def drain(self) -> None:
        """Do what the recorder's writer does 20 times a second."""
        assert self.session is not None
        batch, self.queue = self.queue, []
        for each in batch:
            self.session.add(
                each.key_expr,
                each.payload,
                each.encoding,
                cast("Any", each.timestamp),
                cast("Any", each.source_info),
                self.now_ns,
            )
        ready = [each for each in self.answers if each[0] <= self.now]
        self.answers = [each for each in self.answers if each[0] > self.now]
        for _, query, found, is_whole in ready:
            for each in found:
                self.session.add_backfilled(cast("Any", each), self.now_ns, is_of_all=self.plan.asks_for_all(query))
            if is_whole:
                self.plan.add_answers(query, {each.key_expr for each in found})
        if self.session.gaps:
            for key, before in self.session.gaps.items():
                at = self.now - (self.now_ns - before) / 1e9
                self.gaps[key] = min(at, self.gaps.get(key, self.now))
            self.session.gaps.clear()
        self.newcomers |= self.session.newcomers
        self.session.newcomers.clear()

    def tick(self) -> None:
        """Do what the recorder's writer does each second."""
        session = self.session
        assert session is not None
        session.tick(self.now_ns)
        if session.over and not session.full:
            self.start(after=session)
            session.close(self.now_ns)
        self.touch()

    def touch(self) -> None:
        """Give the newest file the time of this clock."""
        assert self.session is not None
        for path in sorted(self.session.path.glob(SEGMENTS))[-1:]:
            os.utime(path, ns=(self.now_ns, self.now_ns))

    def poll(self) -> None:
        """Do what the backfill does five times a second."""
        self.plan_missing()
        if self.recorder_linked and self.link != self.recorder_back_at:
            self.plan.add_reconnect(self.connected_since, self.now)
        if self.recorder_linked:
            self.link = self.recorder_back_at
            self.connected_since = self.polls[0]
            for query in self.plan.due_queries(self.now):
                self.ask(query)
        self.polls.append(self.now)

    def plan_missing(self) -> None:
        """Plan queries for gaps and newcomers."""
        gaps, self.gaps = self.gaps, {}
        newcomers, self.newcomers = self.newcomers, {}
        self.plan.add_gaps(gaps, self.polls[0], self.now)
        self.plan.add_newcomers(newcomers, self.now)

    def ask(self, query: PlannedQuery, *, delay_s: float | None = None) -> None:
        """Send a query to the publishers' caches."""
        found: list[VirtualSample] = []
        length_s = self.now - query.since
        delay_s = self.moments.choice([0.01, 0.3, 1.0]) * self.moments.random() if delay_s is None else delay_s
        whole = self.moments.random() > self.loss
        for car in self.cars:
            if not car.linked or self.now < car.back_at + 0.2:
                continue
            for publisher in car.publishers:
                if query.source not in (EVERYTHING, f"fleet/{car.name}", publisher.key):
                    continue
                own_now_ns = self.now_ns + int((car.offset_s + delay_s / 2) * 1e9)
                part = [each for each in publisher.cache if each.timestamp.ns >= own_now_ns - length_s * 1e9]
                found += part if whole else part[: len(part) // 2]
        self.answers.append((self.now + delay_s, query, found, whole))

    # ------------------------------------------------------------------ the publishers and their links

    def publish(self, car: PublishingCar, publisher: VirtualPublisher) -> None:
        """Publish one message."""
        own_ns = self.now_ns + int(car.offset_s * 1e9)
        payload = pb.Line(
            car=car.name, seq=publisher.sent, boot_id=publisher.entity.zid, left_inner=bool(publisher.sent % 2)
        )
        data = VirtualPayload(payload.SerializeToString())
        source = VirtualSource(publisher.entity, publisher.sent)
        publisher.sent += 1
        publisher.cache.append(VirtualSample(publisher.key, data, ENCODING, VirtualStamp(own_ns), source))
        self.published[publisher.key.encode() + data] = publisher.key, publisher.entity, source.source_sn + 1, self.now
        if not car.linked or not self.recorder_linked:
            return
        if self.moments.random() < self.loss:
            self.lost_alone.add((publisher.key, publisher.entity, source.source_sn + 1))
            return
        stamp = VirtualStamp(self.now_ns if car.offset_s > AHEAD_S else own_ns)
        delay_s = self.moments.random() * (1.5 if self.moments.random() < self.late else 0.02)
        at = max([self.now + delay_s, *(each for each, _ in car.on_way)])
        car.on_way.append((at, VirtualSample(publisher.key, data, ENCODING, stamp, source)))

    def deliver(self) -> None:
        """Deliver what has arrived."""
        for car in self.cars:
            arrived = [each for at, each in car.on_way if at <= self.now]
            car.on_way = [each for each in car.on_way if each[0] > self.now]
            if self.session is not None and self.recorder_linked and car.linked:
                self.queue += arrived

    def disturb(self) -> None:
        """Let something go wrong, or be well again."""
        moments, car = self.moments, self.moments.choice(self.cars)
        match moments.choices(["cut", "mend", "recorder", "restart", "kill"], [3, 3, 2, 1, 1])[0]:
            case "cut" if car.linked:
                self.tell(f"{car.name} has no link")
                car.linked, car.lost_at = False, self.now
                car.on_way.clear()
            case "mend":
                self.mend(car)
            case "recorder":
                if self.recorder_linked:
                    self.tell("the recorder has no link")
                    self.recorder_linked, self.recorder_lost_at = False, self.now
                elif self.now > self.recorder_lost_at + LEASE_S:
                    self.tell("the recorder has a link")
                    self.recorder_linked, self.recorder_back_at = True, self.now
            case "restart":
                self.tell(f"{car.name} restarts")
                car.life += 1
                car.on_way.clear()
                for index, publisher in enumerate(car.publishers):
                    publisher.entity, publisher.sent = VirtualEntity(f"{car.name}-{car.life}", index), 0
                    publisher.cache.clear()
            case "kill" if self.session is not None and moments.random() < 0.5:
                self.kill()
                self.back_at = self.now + moments.choice([0.5, 3.0, 12.0]) * moments.random()
            case _:
                pass

    def mend(self, car: PublishingCar) -> None:
        """Link a car again."""
        if not car.linked and self.now > car.lost_at + LEASE_S:
            self.tell(f"{car.name} has a link")
            car.linked, car.back_at = True, self.now

    def tell(self, words: str) -> None:
        """Add to the story."""
        self.story.append(f"{self.now:8.2f} {words}")

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        while self.now < end:
            self.now = round(self.now + STEP_S, 6)
            for car in self.cars:
                for publisher in car.publishers:
                    while publisher.due_at <= self.now:
                        publisher.due_at += publisher.interval_s
                        self.publish(car, publisher)
            self.deliver()
            if self.session is None:
                if self.now >= self.back_at:
                    self.start()
                continue
            self.drain()
            if self.now >= self.next_tick:
                self.next_tick += 1.0
                self.tick()
            if self.now >= self.next_poll:
                self.next_poll += BACKFILL_POLL_INTERVAL_S
                self.poll()

    def close(self) -> None:
        """End the recording, as the recorder does."""
        assert self.session is not None
        self.drain()
        for _ in range(2):
            self.plan_missing()
            for query in self.plan.last_queries():
                self.ask(query, delay_s=0.0)
            self.drain()
        self.session.close(self.now_ns)

    # ------------------------------------------------------------------ the judge

    def judge(self) -> None:
        """Compare the files with what was published."""
        recorded: Counter[bytes] = Counter()
        told: Counter[str] = Counter()
        recovered: Counter[str] = Counter()
        for path in self.paths:
            session = Session(path)
            for row in session.messages():
                recorded[row.key.encode() + row.payload] += 1
                if row.key.encode() + row.payload not in self.published:
                    self.violations.append("a message that nobody published")
            info = SessionInfo.read(path)
            assert info is not None
            told.update(info.missed)
            told.update(info.drops)
            recovered.update(info.recovered)
        twice = [self.published[data] for data, count in recorded.items() if count > 1]
        if twice:
            self.violations.append(f"{len(twice)} twice: {twice[:3]}")
        known: dict[tuple[str, VirtualEntity], set[int]] = {}
        for data in recorded:
            key, entity, number, _ = self.published[data]
            known.setdefault((key, entity), set()).add(number)
        lost: Counter[str] = Counter()
        caches = {
            publisher.key: {each.source_info.source_sn + 1 for each in publisher.cache}
            for car in self.cars
            for publisher in car.publishers
        }
        current = {publisher.key: publisher.entity for car in self.cars for publisher in car.publishers}
        for (key, _), numbers in known.items():
            lost[key] += max(numbers) - min(numbers) + 1 - len(numbers)
        for key, entity in current.items():
            there = known.get((key, entity), set())
            wanted = {
                number
                for name, sender, number, at in self.published.values()
                if (name, sender) == (key, entity) and self.known_since < at < self.now - IN_TRANSIT_S
            }
            unseen = {
                each[2] for each in self.lost_alone if each[:2] == (key, entity) and each[2] > max(there, default=0)
            }
            if lacking := sorted((wanted & caches[key]) - there - unseen):
                self.violations.append(f"{key} lacks {lacking} of {len(wanted)}, which its publisher still has")
        if not self.kills:
            for key, count in lost.items():
                if not told[key] - recovered[key] <= count <= told[key]:
                    self.violations.append(f"{key} lost {count}, and says {told[key]} (recovered {recovered[key]})")


def play(seed: int, root: Path) -> RecordingEpisode:
    """Play one recording."""
    episode = RecordingEpisode(seed, root)
    moments = episode.moments
    end = moments.choice([20.0, 60.0])
    while episode.now < end:
        episode.run(moments.choice([0.1, 1.0, 5.0]) * moments.random())
        episode.disturb()
    episode.loss = episode.late = 0.0
    if episode.session is None:
        episode.run(max(0.0, episode.back_at - episode.now) + STEP_S)
    if not episode.recorder_linked:
        episode.run(LEASE_S)
        episode.recorder_linked, episode.recorder_back_at = True, episode.now
    for car in episode.cars:
        if not car.linked:
            episode.run(max(0.0, car.lost_at + LEASE_S + 0.1 - episode.now))
            episode.mend(car)
    episode.run(END_S)
    episode.close()
    episode.judge()
    return episode
