"""The text of a new fleet file and of a first plan. Pure."""

import json
import re
from collections.abc import Sequence
from typing import Final

from msgspec import Struct

from fleet.fleetfile.fleet_file import default_color
from schemas.platform_name import AUTO

SCHEMA_URL: Final = "https://raw.githubusercontent.com/zenoh-car-fleet/zenoh-car-fleet/main/deploy/{}.schema.json"


class NewCar(Struct, frozen=True):
    """A car in a new fleet file."""

    name: str
    link: str
    platform: str
    color: str
    words: str = ""


def quote(text: str) -> str:
    """Format any text as a YAML scalar."""
    return json.dumps(text, ensure_ascii=False)


def format_key(name: str) -> str:
    """Format a car's name as a YAML key, in quotes if YAML would read it as a number (`10`), a boolean or null."""
    return name if name[0].isalpha() and name not in ("null", "true", "false") else quote(name)


def format_new_file(cars: Sequence[NewCar]) -> str:
    """Return the text of a fleet file with these cars."""
    lines = [
        f"# yaml-language-server: $schema={SCHEMA_URL.format('fleet')}",
        "# Your cars. `fleet check` looks for mistakes, `fleet up` connects them all.",
        "cars:",
    ]
    for index, car in enumerate(cars):
        about = car.words.partition(":")[0]
        key = f"  {format_key(car.name)}:"
        lines.append(key if index else f"{key:<28}# the name that you use in commands")
        lines.append(f"    link: {_scalar(car.link)}" + (f"  # {about}" if about else ""))
        if car.platform != AUTO:
            lines.append(f"    platform: {car.platform}")
        if car.color != default_color(car.name, index):
            lines.append(f"    color: {quote(car.color)}")
    lines += [
        "",
        "defaults:                   # for every car",
        "  limits:",
        "    longest_drive_s: 5      # no command drives longer than this",
        "    on_battery_low: warn    # below 7.0 V: warn, refuse or stop",
        "",
        "# groups: {a: [red, blue]}  # for commands: `fleet stop @a`",
        '# people: {group_a: {drives: ["@a"]}, teacher: {rank: lead}}   # who may drive; left out: everyone',
        "# plan: plan.yaml           # what the cars do together",
        "# record: {to: sessions, quota: 20GB}   # where `fleet up` records, and how much it keeps; false: nowhere",
        "# pin: [{when: range_m < 0.1}]          # what the quota removes last, like stops and marks",
    ]
    return "\n".join(lines) + "\n"


def _scalar(text: str) -> str:
    """Format a link as a YAML scalar, without quotes if YAML reads it as text anyway."""
    return text if re.fullmatch(r"(?!null|true|false)[A-Za-z/][\w/.:?&=-]*\w", text, re.ASCII) else quote(text)


def format_new_plan(count: int) -> str:
    """Return the text of a first plan for this number of cars."""
    lines = [
        f"# yaml-language-server: $schema={SCHEMA_URL.format('plan')}",
        "# What the cars do together. Check it with `fleet check plan.yaml`, run it with `fleet up --plan plan.yaml`.",
        "roles:",
    ]
    if count > 1:
        cars = "all others drive around and avoid" if count > 3 else "two cars drive around and avoid"
        cars = "one car drives around and avoids" if count == 2 else cars
        lines.append(f"  patrol: {{mode: obstacle_avoidance, count: {count - 1}}}  # {cars} obstacles")
    lines.append("  guide: {mode: tracking}  # one car follows the line on the floor")
    return "\n".join(lines) + "\n"
