"""The views of the pages for a moment of a recording: the same as live, from the messages that were known then.

The clock is that of the recorder: `now` is the moment, and the age of a message is the time since it was recorded.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from fleet.console.bus_message import is_finite, is_shown
from fleet.console.car_view import CarView, FleetView
from fleet.console.frame_log import FrameLog
from fleet.console.map_view import PLACE_TOPICS, WORLD, MapView
from fleet.console.plan_view import PlanView
from fleet.console.plot_buffer import PlotBuffer, Series
from fleet.recording.tools.lanes import HELD_NS, Lanes
from fleet.recording.tools.moment import Known
from schemas.colors import car_color, hex_color
from schemas.keys import COORDINATOR
from schemas.topics import CAR_TOPICS

DETAIL_BEFORE_NS: Final = 60_000_000_000
"""How far before the moment the commands and frames of one car are shown. A command ends within seconds. A page shows
60 frames: a car that reports once a second sends them in a minute."""
DECISIONS_BEFORE_NS: Final = 600_000_000_000
"""How far before the moment decisions are shown, the newest about each car. They are published only on change."""
PLOT_SLOTS: Final = 600
"""Maximum number of values of one series. A page draws no more (static/plots-page.js)."""
_TOPICS: Final = frozenset(topic.name for topic in CAR_TOPICS)
_MS: Final = 1_000_000
_S: Final = 1e9


def cars_at(known: Iterable[Known], at_ns: int, colors: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return what a page shows of each car at a moment. `known` has what was recorded by then."""
    view = FleetView(lambda name, index: colors.get(name) or hex_color(car_color(name, index)))
    of_cars = [each for each in known if is_told(each)]
    view.list_cars(sorted({each.key.car for each in of_cars}))
    spoke = {each.key.car: each.log_ns for each in of_cars if each.key.topic.startswith("state/")}
    begun = min((each.log_ns for each in of_cars), default=at_ns)
    # Presence is not recorded, so infer it: the gateway of a car publishes each second.
    view.on_presence(spoke, begun / _S)
    for each in of_cars:
        view.on_message(each.key.car, each.key.topic, each.message, each.log_ns / _S)
    for end_ns in sorted({ns + HELD_NS for ns in spoke.values() if ns + HELD_NS < at_ns}):
        view.on_presence([car for car, ns in spoke.items() if ns + HELD_NS > end_ns], end_ns / _S)
    return view.as_list(at_ns / _S)


def is_told(each: Known) -> bool:
    """Return True for a message that a page may get: it is of a car, and JSON can represent all its numbers."""
    return (
        each.key.topic in _TOPICS
        and not each.key.car.startswith("@")
        and is_shown(each.key.car)
        and is_finite(each.message)
    )


def map_at(known: Iterable[Known], trail: Iterable[Known], at_ns: int) -> dict[str, Any]:
    """Return what a map shows of a moment. `trail` has the messages of PLACE_TOPICS before it."""
    view, now = MapView(), at_ns / _S
    placed = [each for each in known if each.key.topic in PLACE_TOPICS]
    # Sort by the time of publishing, as in the tables, because a backfilled message was recorded late.
    for each in (*sorted(trail, key=lambda each: each.publish_ns), *placed):
        if is_told(each):
            view.on_message(each.key.car, each.key.topic, each.message, each.log_ns / _S)
    for each in known:
        if f"{each.key.car}/{each.key.topic}" == WORLD.name and is_finite(each.message):
            view.on_message("", WORLD.name, each.message, each.log_ns / _S)
    return {"cars": view.places(now), "trails": view.trails(now), "world": view.world(now)}


def plan_at(in_force: Iterable[Known], decisions: Iterable[Known]) -> dict[str, Any]:
    """Return what the plan page shows of a moment: the last plan by then, who had which role, and the last decisions.

    A recording does not show whether the coordinator was still running.
    """
    view = PlanView()
    # The plan first, because a new plan discards decisions.
    newest = sorted(in_force, key=lambda each: each.key.topic != "plan")
    for each in (*newest, *sorted(decisions, key=lambda each: each.publish_ns)):
        if each.key.car == COORDINATOR and is_finite(each.message):
            view.on_message(f"{each.key.car}/{each.key.topic}", each.message)
    return view.as_dict()


def detail_of(car: str, messages: Iterable[Known], known: Iterable[Known], at_ns: int) -> dict[str, Any]:
    """Return the frames, commands, events and states of one car before a moment, as the inspect page shows them.

    `messages` are the frames and events of the car. `known` has the newest message of every other topic.
    """
    view, frames = CarView(car, ""), FrameLog()
    view.on_presence(0.0, present=True)
    mine = [*(each for each in known if each.key.car == car and not each.key.topic.startswith(("event/", "frame/")))]
    for each in sorted((*mine, *messages), key=lambda each: each.log_ns):
        if not is_told(each):
            continue
        if each.key.topic.startswith("frame/"):
            frames.on_frame(each.key.topic, each.message)
            if each.key.topic == "frame/tx":
                view.commands.on_frame(each.message)
        else:
            view.on_message(each.key.topic, each.message, each.log_ns / _S)
    return {
        "car": car,
        "frames": frames.as_list(),
        "ledger": list(reversed(view.ledger)),
        "commands": view.commands.as_list(),
        "doctor": view.diagnose(at_ns / _S),
        "gateway": view.describe_gateway(),
    }


def samples_of(
    series: Sequence[Series], messages: Iterable[Known], from_ns: int, to_ns: int
) -> dict[int, list[tuple[int, float]]]:
    """Return the values of each series by its number: for each slot of a plot the last value in it."""
    buffer = PlotBuffer(series)
    for each in messages:
        if is_told(each):
            buffer.add(each.key.car, each.key.topic, each.message, each.log_ns // _MS)
    slot_ms = max(1, -(-(to_ns - from_ns) // _MS // PLOT_SLOTS))  # the two minus signs round up
    return {
        number: list({at_ms // slot_ms: (at_ms, value) for at_ms, value in values}.values())
        for number, values in buffer.take().items()
    }


def lanes_as_dict(lanes: Lanes, end_ns: int) -> dict[str, Any]:
    """Return lanes and marks as JSON values. `end_ns` is the end of the recording."""
    marks = sorted(lanes.marks, key=lambda each: each.at_ns)
    spans = (*lanes.since(0), *lanes.silences(end_ns))
    return {
        "spans": [span.as_list() for span in spans if is_shown(span.car)],
        "marks": [[each.at_ns // _MS, each.words, each.by] for each in marks],
    }
