"""The generated tables of docs/: topics, commands, stops, evidence, modes and platforms, and the numbers in prose."""

import csv
import inspect
import re
from itertools import chain
from typing import Any

from google.protobuf.descriptor import FieldDescriptor

from fleet.bridges.home_assistant import ENTITIES
from fleet.conditions.fields import LAST, fields_of
from fleet.exporter.metrics import METRICS
from gateway.control.driver import STALL_S
from gateway.control.sender_presence import SENDER_GONE_S
from gateway.control.trust import TRANSITIONS, TrustEvent, TrustState
from gateway.drivers.yahboom.protocol.modes import MODES
from gateway.drivers.yahboom.protocol.platforms import Profile, parse_platform
from gateway.drivers.yahboom.protocol.timing import REPEAT_INTERVAL_S
from gateway.drivers.yahboom.stop_renewal import RENEWAL_INTERVALS_S
from gateway.drivers.yahboom.stops.cases import CASES
from schemas import messages, topics
from schemas.commands import COMMANDS
from schemas.limits import DEFAULT_MAX_DRIVE_S, SHUTDOWN_S, STREAM_SILENCE_S
from schemas.words import UNKNOWN, CarTrust, Mode, Platform
from tests.support import vectors
from tests.tools.vectors import STOPS

_COMMON = {"sender", "kind", "id", "asked", "take", "ttl_s"}


def key_table() -> str:
    """Return the table of topics, with rate, cache and views of each."""
    rows = [
        "| key | message | what | units | rate | stale after | class | history | cache | Rerun entity |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for topic in topics.TOPICS.values():
        units = ", ".join(f"{name} {unit}" for name, unit in topic.units.items())
        cells = (
            f"`<fleet>/{topic.name if topic.name.startswith('@') else f'<car>/{topic.name}'}`",
            topic.message,
            topic.about,
            units,
            f"{topic.rate_hz:g}/s" if topic.rate_hz else "",
            f"{topic.stale_after_s:g} s" if topic.stale_after_s is not None else "",
            topic.qos,
            str(topic.history_size or ""),
            str(topic.cache_size),
            f"`{topic.entity}`" if topic.entity else "",
        )
        rows.append(f"| {' | '.join(cell or '-' for cell in cells)} |")
    return "\n".join(rows)


def metric_table() -> str:
    """Return the table of metrics, with the labels of each."""
    rows = ["| metric | labels | what |", "|---|---|---|"]
    for metric in METRICS:
        rows.append(f"| `{metric.sample}` | {', '.join(metric.label_names) or '-'} | {metric.about} |")
    return "\n".join(rows)


def entity_table() -> str:
    """Return the table of the entities of a car in Home Assistant."""
    rows = ["| value | name | unit or words |", "|---|---|---|"]
    for entity in ENTITIES:
        words = entity.config.get("options", ("true", "false") if entity.config["platform"] == "binary_sensor" else ())
        unit = entity.config.get("unit_of_measurement") or ", ".join(word for word in words if word != UNKNOWN)
        rows.append(f"| `{entity.name}` | {entity.title} | {unit} |")
    return "\n".join(rows)


def verb_table() -> str:
    """Return the table of commands, with the fields of each message."""
    rows = ["| verb | fields | what |", "|---|---|---|"]
    for verb, row in COMMANDS.items():
        fields: Any = messages.message_class(row.message).DESCRIPTOR.fields
        own = [_field(field) for field in fields if field.name not in _COMMON]
        rows.append(f"| `{verb}` | {', '.join(own) or '-'} | {row.about} |")
    return "\n".join(rows)


def _field(field: FieldDescriptor) -> str:
    return f"`{field.name}`" + ("..." if field.is_repeated else "")


_STATES = {
    "manual, nothing unread": "driving or at rest",
    "manual, a frame may be unread": "driving or at rest, just after another command",
    "manual, in a block of ours": "sounding the whistle or moving a servo",
    "in a mode that reads pins": "in tracking, light seeking, following or infrared remote mode",
    "in color_led": "color LED mode",
    "in obstacle_avoidance": "in obstacle avoidance, at worst with obstacles all around",
    "opening": "opening a mode (the slowest mode)",
    "link just restored": "just connected again, after the link broke in the middle of a frame",
    "raspberry_pi": "a Raspberry Pi car (its slowest state)",
    "stm32": "an stm32 car (its slowest state)",
    "unknown": "a car whose platform is not known, in mode 0 (its slowest state)",
}
"""Name of each state of the distribution on the page. Of several rows with this beginning, the longest time counts."""


def stops() -> list[dict[str, str]]:
    """Return the distribution of stops that `make vectors` wrote."""
    with STOPS.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file, delimiter="\t"))


def _rows(name: str) -> list[dict[str, str]]:
    """Return the rows of this state, or of the group of states that begins with this name."""
    grouped = name in ("opening", "raspberry_pi", "stm32", "unknown")
    named = [row for row in stops() if row["state"] == name]
    begun = [row for row in stops() if row["state"].startswith(name)]
    return [row for row in begun if not row["state"].endswith(("restored", "under way"))] if grouped else named


def _longest(name: str, column: str) -> float:
    """Return the longest time of a column in the rows of this name, 0 if no row has a time."""
    times = [float(row[column]) for row in _rows(name)]
    assert times, f"no row of {STOPS.name} is in the state {name}"
    return max((each for each in times if each != float("inf")), default=0.0)


def _shown_after(name: str) -> str:
    """Return the time at which the car had shown its stop, and the number of stops that it did not show."""
    rows = _rows(name)
    stops_shown, asked = sum(int(row["shown"]) for row in rows), sum(int(row["stops"]) for row in rows)
    if not stops_shown:
        return "never"
    middle, worst = _longest(name, "shown_p50_s"), _longest(name, "shown_worst_s")
    return f"{middle:.1f} s, at worst {worst:.1f} s ({100 * stops_shown / asked:.0f} % of stops)"


def stop_table() -> str:
    """Return the table of the times of a stop, by the state of the car."""
    rows = ["| the car is | in the middle | worst seen | longest announced | shown after |", "|---|---|---|---|---|"]
    for name, words in _STATES.items():
        middle, worst, announced = (_longest(name, column) for column in ("p50_s", "worst_s", "announced_s"))
        rows.append(f"| {words} | {middle:.2f} s | {worst:.2f} s | {announced:.2f} s | {_shown_after(name)} |")
    return "\n".join(rows)


def evidence_table() -> str:
    """Return the table of evidence for a stop, from the gateway's own table."""
    rows = ["| stop | shown by | otherwise |", "|---|---|---|"]
    rows += [f"| {row.stop} | {row.shown_by or 'nothing'} | {row.otherwise} |" for row in CASES]
    return "\n".join(rows)


def trust_table() -> str:
    """Return the states of trust with their docstrings."""
    about = dict(re.findall(r'^    [A-Z_]+ = "(\w+)"\n    """(.+?)"""', inspect.getsource(CarTrust), re.MULTILINE))
    rows = ["| trust | motors | what the gateway believes |", "|---|---|---|"]
    rows += [f"| `{state}` | {TrustState(state).motors} | {about[state]} |" for state in CarTrust]
    return "\n".join(rows)


def transition_table() -> str:
    """Return the next state for each state and event. A dot means no change."""
    rows = [f"| what happens | {' | '.join(f'`{state}`' for state in CarTrust)} |", "|---" * (len(CarTrust) + 1) + "|"]
    for event in TrustEvent:
        to = [TRANSITIONS[state, event] for state in CarTrust]
        cells = ["·" if new is state else str(new) for state, new in zip(CarTrust, to, strict=True)]
        rows.append(f"| {event} | {' | '.join(cells)} |")
    return "\n".join(rows)


def mode_table() -> str:
    """Return the table of pairs of commanded and true mode that readings distinguish, with the times."""
    groups: dict[tuple[str, str, str], dict[str, list[str]]] = {}
    for row in vectors.rows("mode_truth"):
        key = (row["verdict"], row["by"], row["within_s"])
        groups.setdefault(key, {}).setdefault(row["asked"], []).append(row["true"])
    everything = {each["true"] for each in vectors.rows("mode_truth")}
    rows = ["| asked | in truth | verdict | by | within |", "|---|---|---|---|---|"]
    for (verdict, by, within), pairs in groups.items():
        alike: dict[tuple[str, ...], list[str]] = {}
        for asked, true in pairs.items():
            every = set(true) == everything - {asked}
            others = ("any other",) if every else tuple("the same" if each == asked else each for each in true)
            alike.setdefault(others, []).append(asked)
        for others, named in alike.items():
            limit = f"{within} s"
            if within == "-":
                limit = "never" if verdict == "assumed" else "the first reading"
            rows.append(f"| {', '.join(named)} | {', '.join(others)} | {verdict} | {by} | {limit} |".replace("_", " "))
    return "\n".join(rows)


def numbers() -> dict[str, str]:
    """Return the numbers that pages have in their prose, from the code and from the distribution of stops."""
    middle, worst = (_longest("manual, nothing unread", column) for column in ("p50_s", "worst_s"))
    return {
        "stop_middle": f"{middle:.2f} s",
        "stop_worst": f"{worst:.1f} s",
        "restored_worst": f"{_longest('link just restored', 'worst_s'):.1f} s",
        "repeat": f"{REPEAT_INTERVAL_S:g} s",
        "renewals": f"{RENEWAL_INTERVALS_S[0]:g} s, {RENEWAL_INTERVALS_S[1]:g} s and then every "
        f"{RENEWAL_INTERVALS_S[2]:g} s",
        "stream_silence": f"{STREAM_SILENCE_S:g} s",
        "longest_drive": f"{DEFAULT_MAX_DRIVE_S:g} s",
        "sender_gone": f"{SENDER_GONE_S:g} s",
        "stall": f"{STALL_S:g} s",
        "shutdown": f"{SHUTDOWN_S:g} s",
        "stops_per_row": str(max(int(row["stops"]) for row in stops())),
    }


def report_table() -> str:
    """Return the table of a car's reports in each mode."""
    rows = ["| mode | number | what the car reports |", "|---|---|---|"]
    for mode in Mode:
        measured = sorted(parse_platform("arduino").measurable(mode))
        told = ", ".join(f"`sensor/{each}`" for each in measured) or "nothing"
        rows.append(f"| `{mode}` | {MODES[mode].digit} | {told} |")
    return "\n".join(rows)


def platform_table() -> str:
    """Return the table of the abilities of each platform."""
    profiles: dict[str, Profile] = {kind: parse_platform(kind) for kind in Platform}
    rows = [f"| | {' | '.join(f'`{kind}`' for kind in profiles)} |", "|---" * (len(profiles) + 1) + "|"]
    every = sorted(set(chain.from_iterable(each.capabilities for each in profiles.values())))
    rows += [
        f"| {word} | {' | '.join('yes' if word in each.capabilities else '-' for each in profiles.values())} |"
        for word in every
    ]
    for title, names in (
        ("modes", lambda each: each.modes),
        ("silent modes", lambda each: each.silent_modes),
        ("lights", lambda each: each.lights),
        ("servo actions", lambda each: each.servos),
        ("readings that are constants, so not published", lambda each: [name for name, _ in each.constants]),
        ("not observed on a running program", lambda each: each.not_observed),
    ):
        cells = [", ".join(sorted(str(name) for name in names(each))).replace("_", " ") for each in profiles.values()]
        rows.append(f"| {title} | {' | '.join(cell or '-' for cell in cells)} |")
    return "\n".join(rows)


def condition_table() -> str:
    """Return the fields that a condition may name, by topic."""
    kinds = {float: "number", bool: "yes/no", str: "word"}
    rows = ["| topic | fields |", "|---|---|"]
    for topic in topics.CAR_TOPICS:
        if topic.family in ("sensor", "state", "sim"):
            fields = fields_of(messages.message_class(topic.message)).items()
            told = [f"`{name}` {kinds[kind]}" for name, kind in fields if name not in LAST]
            rows.append(f"| `{topic.name}` | {', '.join(told)} |")
    return "\n".join(rows)
