"""The state of each car as the pages show it, from messages of the bus. Pure: time is an argument (s, monotonic)."""

import math
from collections import deque
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any, Final

from msgspec import Struct, field

from fleet.client.car_state import CarState
from fleet.client.diagnosis import FAILED_PHASES, CarEvidence, describe, diagnose, doubtful
from fleet.client.gateway_clock import GatewayClock
from fleet.console.abilities import UNKNOWN_ABILITIES, abilities_of
from fleet.console.command_ledger import CommandLedger
from fleet.console.frame_log import describe_gateway
from fleet.console.page_requests import MAX_CARS
from fleet.supervisor.temporary_gateway import TEMPORARY_PREFIX
from schemas import keys, messages, topics
from schemas.rights import Authority, People, PersonRole, binding_pause
from schemas.words import UNKNOWN, Level, LinkState, Verdict

TREND_WINDOW_S: Final = 240.0
"""Time over which the trend of a battery is measured."""
TREND_SAMPLE_INTERVAL_S: Final = 5.0
_MIN_TREND_S: Final = 30.0
"""Minimum time that the readings must cover for a trend."""
TREND_STEADY_V: Final = 0.03
"""Maximum change of a steady battery. The readings have steps of 0.01 V."""
MAX_LEDGER_ENTRIES: Final = 60
"""Maximum commands and log records of a car that a page can show."""
SILENT_AFTER_S: Final = topics.TOPICS["state/safety"].stale_after_s or 0.0
"""After this time without any message of a car, its card says how old its state is. A live gateway repeats the
state."""
MAX_LISTED_CARS: Final = MAX_CARS
"""Maximum number of cars of the running fleet: as many as one message of a page may name."""
# Without `fleet up`, nobody lists the cars. No measurement had more than fifty gateways on one bus. Anybody on the bus
# may take a place. Each place costs a card that is made ten times a second, and some 0.1 MB when its lists are full.
MAX_OTHER_CARS: Final = 64
"""Maximum number of cars that the running fleet does not list."""
_LINES: Final = ("left_outer", "left_inner", "right_inner", "right_outer")
_SIDES: Final = ("left", "right")


class BatteryTrend(Struct):
    """The change of a battery's voltage over some minutes."""

    _samples: deque[tuple[float, float]] = field(default_factory=deque)

    def add(self, voltage_v: float, now: float) -> None:
        """Add a voltage. Skip most voltages, because a trend needs only a few."""
        if self._samples and now - self._samples[-1][0] < TREND_SAMPLE_INTERVAL_S:
            return
        self._samples.append((now, voltage_v))
        while now - self._samples[0][0] > TREND_WINDOW_S:
            self._samples.popleft()

    @property
    def words(self) -> str:
        """`falling`, `steady`, `rising`, or empty if it is too early to tell."""
        if not self._samples or self._samples[-1][0] - self._samples[0][0] < _MIN_TREND_S:
            return ""
        half = len(self._samples) // 2
        voltages = [voltage for _, voltage in self._samples]
        change = sum(voltages[half:]) / (len(voltages) - half) - sum(voltages[:half]) / half
        if abs(change) < TREND_STEADY_V:
            return "steady"
        return "rising" if change > 0 else "falling"


class CarView:
    """The newest messages of one car."""

    def __init__(self, name: str, color: str, now: float = 0.0) -> None:
        self.name = name
        self._since = now
        self.color = color
        self.ledger: deque[dict[str, Any]] = deque(maxlen=MAX_LEDGER_ENTRIES)
        """Commands and log records, the newest last."""
        self.authority = Authority()
        """The rights of each person. Cached: a page asks ten times a second."""
        self.names_people = False
        """True if a gateway of this car has said who may drive it."""
        self.commands = CommandLedger()
        self._events: deque[tuple[float, Any]] = deque(maxlen=MAX_LEDGER_ENTRIES)
        """Time and event of the newest commands."""
        self.state = CarState(name)
        self._clock = GatewayClock()
        self._trend = BatteryTrend()
        self._heard_at: float | None = None
        """When the newest message came."""
        self._changed_at: float | None = None
        """When the gateway joined or left the bus, or None if it is not known yet whether it is there."""

    @property
    def last_sign_at(self) -> float:
        """When the newest message came. Before the first message: when the car came into view."""
        return self._since if self._heard_at is None else self._heard_at

    def on_message(self, topic: str, value: Any, now: float, wall_ns: int | None = None) -> None:
        """Handle a message of this car, on a topic such as `sensor/range`.

        `wall_ns` is the time by our clock if the message was published just now, else None.
        """
        if wall_ns is not None and topic.startswith("state/"):
            self._clock.take(value.boot_id, messages.stamp_ns(value.stamp), wall_ns)
        if topic not in topics.FROM_OUTSIDE:
            self._heard_at = now
        match topic:
            case "event/command":
                self._on_command(value)
                self.commands.on_event(value)
                self._events.append((now, value))
            case "event/log":
                words = value.message.removeprefix(f"{self.name} ")
                level = messages.level_of(value)
                self._note(value.timestamp, words, Level.INFO if level is Level.DEBUG else level)
            case _:
                if not self.state.take(topic, value, now):
                    return
                if topic == "sensor/battery":
                    self._trend.add(value.voltage_v, now)
                elif topic == "state/safety":
                    self.authority, self.names_people = Authority.of(value), True

    def on_presence(self, now: float, *, present: bool) -> None:
        """Note whether the car's gateway is on the bus."""
        if self._changed_at is None:
            self.state.present = present
        elif present is self.state.present:
            return
        self.state.on_presence(present=present)
        self._changed_at = now

    @property
    def _gone_at(self) -> float | None:
        """When the gateway left the bus. None if it is there, or was never seen."""
        return None if self.state.present else self._changed_at

    def describe_gateway(self) -> list[tuple[str, str]]:
        """Return what the car's gateway knows, as names and texts. It is empty if the gateway is gone."""
        if self._gone_at is not None:
            return []
        return describe_gateway(*(self.state.current(f"state/{name}") for name in ("link", "health", "safety", "mode")))

    def diagnose(self, now: float) -> dict[str, Any]:
        """Return what `fleet doctor` says of the car, as far as its messages tell.

        Each fact has a name, words, and True if it is in doubt.
        """
        state = self.state if self._changed_at is not None else CarState(self.name, present=False)
        evidence = CarEvidence(
            state, now, [(now - at, event) for at, event in self._events], clock_off_s=self._clock.off_s
        )
        # The recorder and the plan have their own pages.
        doubts = doubtful(evidence)
        facts = [(name, words, name in doubts) for name, words in describe(evidence) if name != "services"]
        return {"findings": [str(finding) for finding in diagnose(evidence)], "facts": facts}

    def as_dict(self, now: float) -> dict[str, Any]:
        """Return what a page shows of the car, as JSON values.

        Numbers are rounded, so that most are the same the next time.
        """
        shown: dict[str, Any] = {"name": self.name, "color": self.color}
        shown["gateway"] = self.state.present and self._changed_at is not None
        if self._gone_at is not None:
            shown["gone_s"] = int(now - self._gone_at)
        if self._heard_at is not None and now - self._heard_at > SILENT_AFTER_S:
            shown["silent_s"] = int(now - self._heard_at)
        for part in (self._link, self._mode, self._motion, self._safety, self._health, self._sensors):
            shown |= part(now)
        if self.ledger:
            shown["event"] = self.ledger[-1]
        return shown

    def _link(self, now: float) -> dict[str, Any]:
        claim = self.state.claims(now).link
        if claim.is_stale or (claim.age_s is None and claim.past is None):
            return {"link": {"state": UNKNOWN, "reason": "", "since_s": 0}}
        # A growing number that nobody needs would make the page draw the card again each second.
        is_calm = claim.past is not None or claim.what == LinkState.ONLINE
        since_s = 0 if is_calm else int(claim.since_s or 0)
        state = "unreadable" if self.state.is_unreadable else claim.what
        return {"link": {"state": state, "reason": claim.why, "since_s": since_s}}

    def _mode(self, now: float) -> dict[str, Any]:
        claim = self.state.claims(now).mode
        if claim.age_s is None or claim.is_stale:
            return {"mode": {"asked": UNKNOWN, "inferred": UNKNOWN, "verdict": Verdict.ASSUMED, "evidence": ""}}
        return {
            "mode": {
                "asked": claim.what,
                "inferred": self.state.mode.inferred,
                "verdict": claim.basis,
                "evidence": claim.why,
            }
        }

    def _motion(self, now: float) -> dict[str, Any]:
        motion = self.state.motion
        if self.state.is_stale("state/motion", now) or not self.state.present:
            return {"motion": {"motion": UNKNOWN, "owner": "", "speed": None, "fan": False, "servo_deg": None}}
        shown = {
            "motion": motion.motion,
            "source": motion.source,
            "owner": motion.owner,
            "speed": round(motion.speed, 2),
            "fan": motion.fan,
            "servo_deg": round(motion.servo_deg) if motion.HasField("servo_deg") else None,
        }
        return {"motion": shown}

    def _safety(self, now: float) -> dict[str, Any]:
        safety, claim = self.state.newest("state/safety"), self.state.claims(now).motors
        motors: dict[str, Any] = {"state": claim.what, "basis": claim.basis}
        past = claim if claim.is_stale else claim.past
        if past is not None:  # show an old claim as a past one, with its age
            motors = {"state": UNKNOWN, "basis": "", "past": past.with_basis, "past_s": int(past.age_s or 0)}
        shown: dict[str, Any] = {"motors": motors, "hold": None, "lease": None, "estops": []}
        if safety is None:
            return shown
        if safety.HasField("hold"):
            shown["hold"] = safety.hold.by
        if safety.HasField("lease"):
            shown["lease"] = {"holder": safety.lease.holder, "kind": safety.lease.kind}
        if safety.HasField("loan"):
            until_s = round(safety.stamp.seconds + safety.loan.expires_in_s, -1)
            shown["loan"] = {"to": safety.loan.to, "by": safety.loan.by, "until_s": until_s}
        if (pause := binding_pause(safety.pauses)) is not None:
            shown["pause"] = {"by": pause.by, "why": pause.why}
        shown["people"] = [*safety.people.drivers, *safety.people.others]
        shown["estops"] = [
            {
                "id": each.id,
                "by": each.by,
                "why": each.why,
                "scope": each.scope,
                "since": each.stamp.seconds,
            }
            for each in safety.estops
        ]
        return shown

    def _health(self, _: float) -> dict[str, Any]:
        health = self.state.newest("state/health")
        if health is None:
            return {"platform": "", **UNKNOWN_ABILITIES.as_dict()}
        return {
            "platform": health.platform,
            "shows": "doubt" if health.doubted else health.shows_stops,
            "shows_words": health.shows_stops_words,
            **abilities_of(health.platform, tuple(health.capabilities)).as_dict(),
        }

    def _sensors(self, now: float) -> dict[str, Any]:
        shown: dict[str, Any] = {}
        if (battery := self.state.fresh("sensor/battery", now)) is not None:
            shown["battery"] = {
                "v": round(battery.voltage_v, 1),
                "charge": round(battery.charge, 1) if battery.HasField("charge") else None,
                "level": battery.level,
                "trend": self._trend.words,
            }
        if (range_ := self.state.fresh("sensor/range", now)) is not None:
            shown["range_m"] = round(range_.range_m, 2) if range_.HasField("range_m") else None
        if (line := self.state.fresh("sensor/line", now)) is not None:
            shown["line"] = [getattr(line, name) for name in _LINES]
        for name in ("obstacle", "light"):
            if (pair := self.state.fresh(f"sensor/{name}", now)) is not None:
                shown[name] = [getattr(pair, side) for side in _SIDES]
        return shown

    def _on_command(self, event: Any) -> None:
        words = f"{event.verb} {event.phase}"
        if event.reason or event.words:
            words += f": {event.words or event.reason}"
        level = Level.WARNING if event.phase in FAILED_PHASES else Level.INFO
        self._note(event.stamp, f"{words} ({keys.name_of(event.sender)})", level)

    def _note(self, stamp: Any, words: str, level: str) -> None:
        self.ledger.append({"at_ms": messages.stamp_ms(stamp), "words": words, "level": level})


class FleetView:
    """The cars that the console knows: all that were on the bus since it started, up to a bound.

    Anybody on the bus may invent a name, so the number of places is bounded. A car that the running fleet lists always
    has a place. Any other car gets a free place, or the place of the car that has been silent the longest. A car that
    still publishes keeps its place.
    """

    def __init__(self, color_of: Any) -> None:
        self._color_of = color_of
        self._cars: dict[str, CarView] = {}
        self._listed: frozenset[str] = frozenset()
        self._removed: frozenset[str] = frozenset()
        """Cars that `fleet reload` has removed. Each is forgotten when its gateway has gone."""
        self.left_out = ""
        """The first car for which there was no place, or the car that lost its place. Empty if there is no such car."""

    def list_cars(self, names: Iterable[str], removed: Iterable[str] = ()) -> None:
        """Set the cars that the running fleet lists, and note those that it has listed and does not list any more.

        Cars beyond the maximum are treated as cars that it does not list.
        """
        self._listed = frozenset(islice(filter(keys.is_name, names), MAX_LISTED_CARS))
        self._removed = (self._removed | frozenset(removed)) & self._cars.keys() - self._listed

    def on_message(self, name: str, topic: str, value: Any, now: float, wall_ns: int | None = None) -> None:
        """Handle a message of a car, as `CarView` does. If there is no place for the car, the message is ignored."""
        if (car := self._placed(name, now)) is not None:
            car.on_message(topic, value, now, wall_ns)

    def _placed(self, name: str, now: float) -> CarView | None:
        """Return the view of a car. A new one is added, if there is a place."""
        if name not in self._cars:
            if name not in self._listed and not self._make_room(MAX_OTHER_CARS - 1, now - SILENT_AFTER_S):
                self.left_out = self.left_out or name
                return None
            self._cars[name] = CarView(name, self._color_of(name, len(self._cars)), now)
        return self._cars[name]

    def _make_room(self, most: int, silent_since: float) -> bool:
        """Forget unlisted cars until `most` are left, the longest silent first.

        Return False if this would forget a car that was heard after `silent_since`.
        """
        others = [car for name, car in self._cars.items() if name not in self._listed]
        for car in sorted(others, key=lambda car: car.last_sign_at)[: max(0, len(others) - most)]:
            if car.last_sign_at >= silent_since:
                return False
            self.left_out = self.left_out or car.name
            del self._cars[car.name]
        return True

    def may_show(self, name: str) -> bool:
        """Return True if a page may be told of this car."""
        return name in self._cars or name in self._listed

    def look_up(self, name: str) -> CarView:
        """Return the view of a car. An unknown car gets an empty view, which is not kept: a page may name any car."""
        return self._cars.get(name) or CarView(name, "")

    def update_colors(self) -> None:
        """Ask for the color of each car again."""
        for index, (name, car) in enumerate(self._cars.items()):
            car.color = self._color_of(name, index)

    @property
    def names(self) -> list[str]:
        """The names of all cars."""
        return sorted(self._cars)

    def on_presence(self, present: Iterable[str], now: float) -> None:
        """Handle the names of the cars whose gateways are on the bus."""
        there = set(present)
        for name in sorted(there - set(self._cars), key=lambda name: name not in self._listed):
            if self._placed(name, now) is None:
                break  # the cars after this one find no place either
        self._make_room(MAX_OTHER_CARS, math.inf)  # some may not be listed any more
        for name, car in self._cars.items():
            car.on_presence(now, present=name in there)
        # A car that blinked under a temporary name has got a name of its own, and so may a removed car have. Neither is
        # lost: nobody shall look for it, or read at each STOP that it was not reached.
        over = [each for each in self._cars if each.startswith(TEMPORARY_PREFIX) or each in self._removed]
        for name in set(over) - there:
            del self._cars[name]

    def as_list(self, now: float) -> list[dict[str, Any]]:
        """Return what a page shows of each car, by name."""
        return [self._cars[name].as_dict(now) for name in self.names]

    def newest(self, now: float) -> Iterator[tuple[str, str, float, Any]]:
        """Yield car, topic, age (s) and message of everything that is known of all cars."""
        for name, car in self._cars.items():
            for topic, seen in car.state.newest_by_topic.items():
                yield name, topic, max(0.0, now - seen.at), seen.message

    @property
    def people(self) -> People | None:
        """The people of the fleet. None if no gateway has named them yet."""
        found = [car.authority.people for car in self._cars.values() if car.names_people]
        return People.merged(found) if found else None

    def people_of(self, cars: Iterable[str]) -> People:
        """Return the people of all these cars: whoever is a lead of each of them is a lead."""
        leads = (set(self.look_up(car).authority.people.leads) for car in cars)
        return People(dict.fromkeys(set.intersection(*leads), PersonRole.LEAD))

    @property
    def authority(self) -> dict[str, Authority]:
        """The authority of each car, by name."""
        return {name: self._cars[name].authority for name in self.names}
