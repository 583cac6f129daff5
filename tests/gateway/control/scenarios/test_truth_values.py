"""The gateway never publishes filler as measured, whatever mode the car is in or leaves. The simulated car judges."""

from collections import deque
from typing import Any, NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.control.commands import Drive, Fan, SetMode, Stop
from gateway.control.driver import Event
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from gateway.drivers.yahboom.protocol.sensors import Sensors, read_sensors, sensors_matcher
from schemas.words import Mode, Motion
from tests.support.truth import WORLDS, car_in, frame_of
from tests.support.virtual import Pair

ALL = frozenset({"range", "battery", "grayscale", "line", "obstacle", "light"})
MEASURED = {
    Mode.MANUAL: ALL,
    Mode.TRACKING: frozenset({"line"}),
    Mode.LIGHT_SEEKING: frozenset({"light"}),
    Mode.FOLLOWING: frozenset({"obstacle"}),
}
"""Measured fields by mode (docs/reference/protocol.md#placeholders). A raspberry_pi car sends constants for battery and
grayscale."""


class Sent(NamedTuple):
    """A frame as the car made it, with the sensor values that its program had read last."""

    text: bytes
    mode: Mode
    obstacle: tuple[bool, bool]
    line: tuple[bool, bool, bool, bool]
    light: tuple[bool, bool]


class Source:
    """Records the true mode of each frame, and the fields of each frame that a gateway publishes."""

    def __init__(self, pair: Pair) -> None:
        self.pair = pair
        self.sent: deque[Sent] = deque(maxlen=400)
        self.published: list[tuple[Sensors, frozenset[str], tuple[bool, bool] | None]] = []
        send, heard = pair.car._send, pair.control.driver.on_event
        seen: dict[str, Any] = {name: self._noted(name) for name in ("obstacle", "line", "light")}

        def noting(data: bytes) -> None:
            values: dict[str, Any] = {name: last[-1] if last else () for name, last in seen.items()}
            self.sent.append(Sent(data.rstrip(b"#"), pair.car.truth.mode, **values))
            send(data)

        def publishing(event: Event, now: float) -> None:
            if isinstance(event, Sensors):
                profile, confirmed = pair.control.driver.model.profile, pair.control.driver.model.mode.confirmed
                published = profile.measured(event, confirmed), profile.obstacle(event, confirmed)
                self.published.append((event, *published))
            heard(event, now)

        pair.car._send = noting  # type: ignore[method-assign]  # where a frame leaves the program
        pair.control.driver.on_event = publishing  # type: ignore[method-assign]  # where car.py publishes it

    def _noted(self, name: str) -> deque[Any]:
        """Record the reads of one sensor. Return a queue with the last value."""
        last: deque[Any] = deque(maxlen=1)
        read = getattr(self.pair.car._body, name)

        def reading(now: float) -> Any:
            last.append(read(now))
            return last[-1]

        setattr(self.pair.car._body, name, reading)
        return last

    def origin(self, event: Sensors) -> Sent:
        """Return the newest frame that has the text of the event."""
        text = event.raw.rstrip(b"#")
        return next(sent for sent in reversed(self.sent) if sent.text == text)

    def check(self) -> None:
        """Require that all published fields were measured, and have the values that the program read."""
        constants = {"battery", "grayscale"} if self.pair.control.driver.model.profile.kind == "raspberry_pi" else set()
        for event, measured, obstacle in self.published:
            sent = self.origin(event)
            assert measured <= MEASURED[sent.mode] - constants, (event.raw, sent.mode)
            assert obstacle in (None, sent.obstacle), (event.raw, sent)
            if "line" in measured:
                assert event.line == sent.line
            if "light" in measured:
                assert event.light == sent.light
        self.published.clear()


modes = st.sampled_from(list(Mode))
ACTIONS = st.one_of(
    st.tuples(st.just("ask"), modes),
    st.tuples(st.just("another writer"), modes),
    st.tuples(st.sampled_from(["reset", "drive", "stop", "fan", "wait"]), st.just(Mode.MANUAL)),
)


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(["arduino", "stm32", "raspberry_pi"]),
    st.sampled_from(list(WORLDS)),
    st.lists(st.tuples(ACTIONS, st.floats(0.02, 6.0)), max_size=8),
)
def test_filler_is_never_published_whatever_happens(
    platform: str, world: str, story: list[tuple[tuple[str, Mode], float]]
) -> None:
    pair = Pair(platform, world=WORLDS[world]())
    source = Source(pair)
    pair.ready()
    for (what, mode), seconds in story:
        match what:
            case "ask":
                pair.ask(SetMode(mode))
            case "another writer":
                pair.car.feed(frame_of(mode), pair.now)
            case "reset":
                pair.car.brown_out(pair.now)
            case "drive":
                pair.ask(Drive(Motion.FORWARD, 1.0))
            case "stop":
                pair.ask(Stop())
            case "fan":
                pair.ask(Fan())
            case _:
                pass
        pair.run(seconds)
        source.check()


@pytest.mark.parametrize("mode", MEASURED)
@pytest.mark.parametrize("world", WORLDS)
def test_measured_values_of_each_mode_are_published(mode: Mode, world: str) -> None:
    pair = car_in(mode, world, seed=5)
    source = Source(pair)
    pair.run(10.0)
    wanted = MEASURED[mode]
    assert source.published
    assert all(measured == wanted for _, measured, _ in source.published)
    source.check()


def test_no_echo_is_said_and_is_no_distance() -> None:
    pair = car_in(Mode.MANUAL, "no-echo", seed=5)
    source = Source(pair)
    pair.run(6.0)
    assert [event.range_cm for event, _, _ in source.published] == [0.0] * len(source.published)
    assert all("range" in measured for _, measured, _ in source.published), "no echo is measured: 0 in the reading"


@pytest.mark.parametrize("mode", [mode for mode in MEASURED if mode is not Mode.MANUAL])
@given(data=st.data())
def test_damaged_frame_publishes_no_filler_in_confirmed_mode(mode: Mode, data: st.DataObject) -> None:
    """One byte is wrong or lost. Without a checksum the frame may look like a mode-0 frame."""
    texts = {
        Mode.TRACKING: b"$4WD,CSB0,PV8,GS0,LF0110,HW00,GM00",
        Mode.LIGHT_SEEKING: b"$4WD,CSB120,PV8.3,GS000,LF0000,HW00,GM10",
        Mode.FOLLOWING: b"$4WD,CSB120,PV8.3,GS000,LF0000,HW10,GM00",
    }
    text = texts[mode]
    place = data.draw(st.integers(0, len(text) - 1))
    other = data.draw(st.one_of(st.just(b""), st.sampled_from(b"0123456789.,").map(lambda byte: bytes([byte]))))
    found = sensors_matcher("4WD").fullmatch_unended(text[:place] + other + text[place + 1 :])
    if found:
        for terminated in (True, False):
            event = read_sensors(found, 1.0, terminated=terminated)
            for platform in ("arduino", "stm32", "unknown"):
                assert parse_platform(platform).measured(event, mode) <= MEASURED[mode], event.raw
