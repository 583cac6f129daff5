"""Parses faults and presses of the infrared remote, from the command line and from the control channel. Pure.

`simulation` carries them out, with `model.faulty_link` and `endpoints`.
"""

import math
import re
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Final

from msgspec import Struct

from gateway.sim.car_spec import BadSpec, CarSpec, PtyPath, ReplaySpec
from gateway.sim.model.faulty_link import Direction, Flood
from gateway.sim.model.ir_remote import Button

MAX_GARBAGE_BYTES: Final = 100_000
MAX_FAULT_S: Final = 86_400.0
MAX_FLOOD_BYTES_PER_S: Final = 10_000_000.0
MAX_CUT_BYTES: Final = 256


class FaultKind(StrEnum):
    """A kind of fault of a car or its link."""

    LINK_DROP = "link_drop"
    RENAME = "rename"
    CUT_WRITE = "cut_write"
    SLOW = "slow"
    LOSSY = "lossy"
    STUCK = "stuck"
    DEAF = "deaf"
    MUTE = "mute"
    ECHO = "echo"
    FIREHOSE = "firehose"
    GARBAGE = "garbage"
    BROWNOUT = "brownout"
    EMPTY = "empty"


class Fault(Struct, frozen=True):
    """One fault. Without `car` it hits every car that it can hit (see `targets`).

    A kind ignores the fields that `_FIELDS` does not list for it.
    """

    kind: FaultKind
    car: str | None = None
    for_s: float | None = None
    """Duration in seconds. 0 ends the fault now. With None, it lasts until a fault of the same kind with 0 ends it.

    For `rename` and `cut_write`, it is the duration of the loss of the link that they begin. Only a `link_drop` with 0
    ends that: it ends every loss of the link. For `empty`: the time until the battery is empty.
    """
    bytes: int = 0
    """Number of bytes of garbage, or number of bytes of the next frame that still reach the car before the cut."""
    ways: tuple[Direction, ...] = tuple(Direction)
    """Directions of `lossy` and `garbage`."""
    factor: float = 1.0
    """Rate of a slow link, as a fraction of 960 bytes/s."""
    share: float = 0.0
    """Fraction of the bytes that a lossy link loses."""
    rate: float = 0.0
    """Bytes/s of a firehose. Bytes that the host does not read in time are lost."""
    flood: Flood = Flood.NOISE
    path: str | None = None
    """New path of a renamed pseudo terminal. None means that the path stays and leads to another device."""


class Press(Struct, frozen=True):
    """A press of a button of the remote. Without `car` it is sent to every simulated car."""

    button: Button
    car: str | None = None


class Scheduled(Struct, frozen=True):
    """A fault or press of the command line, with its time after the start."""

    at_s: float
    act: Fault | Press


def targets(cars: Sequence[CarSpec | ReplaySpec], act: Fault | Press) -> list[str]:
    """Return the names of the cars that this affects. Raises BadSpec if the car is unknown or cannot be affected."""
    names = [car.name for car in cars]
    if act.car is not None and act.car not in names:
        raise BadSpec(f"car {act.car!r} is not simulated here: use {', '.join(names)}")
    chosen = [car for car in cars if act.car in (None, car.name)]
    if isinstance(act, Press) or act.kind in (FaultKind.BROWNOUT, FaultKind.EMPTY):
        what = "ir" if isinstance(act, Press) else act.kind.value
        simulated = [car.name for car in chosen if isinstance(car, CarSpec)]
        if not simulated:
            raise BadSpec(f"{what} needs a simulated car, because a replay only repeats its bytes")
        return simulated
    if act.path is not None:
        if act.car is None or not isinstance(chosen[0].link, PtyPath) or chosen[0].link.path is None:
            raise BadSpec(f"path {act.path!r} is not allowed: path needs the name of a car whose link is pty:PATH")
        others = [car.name for car in cars if isinstance(car.link, PtyPath) and car.link.path == act.path]
        if [name for name in others if name != act.car]:
            raise BadSpec(f"path {act.path!r} is not allowed: car {others[0]} already uses it")
    return [car.name for car in chosen]


_WAYS: Final[Mapping[str, tuple[Direction, ...]]] = {
    "host": (Direction.TO_HOST,),
    "car": (Direction.TO_CAR,),
    "both": tuple(Direction),
}
_FIELDS: Final[Mapping[FaultKind, Mapping[str, object]]] = {
    FaultKind.LINK_DROP: {"for_s": None},
    FaultKind.RENAME: {"for_s": 1.0, "path": None},
    FaultKind.CUT_WRITE: {"for_s": None, "bytes": 5},
    FaultKind.SLOW: {"for_s": None, "factor": 0.1},
    FaultKind.LOSSY: {"for_s": None, "share": 0.1, "to": "both"},
    FaultKind.STUCK: {"for_s": None},
    FaultKind.DEAF: {"for_s": None},
    FaultKind.MUTE: {"for_s": None},
    FaultKind.ECHO: {"for_s": None},
    FaultKind.FIREHOSE: {"for_s": None, "rate": 1e6, "of": "noise"},
    FaultKind.GARBAGE: {"bytes": 100, "to": "host"},
    FaultKind.BROWNOUT: {},
    FaultKind.EMPTY: {"for_s": 20.0},
}
"""The fields of each kind with their defaults."""
_RANGES: Final = {
    "for_s": (0.0, MAX_FAULT_S),
    "factor": (0.001, 1.0),
    "share": (0.0, 1.0),
    "rate": (1.0, MAX_FLOOD_BYTES_PER_S),
}


def fault_of(fields: object) -> Fault:
    """Return the fault in a JSON object from the control channel. Raises BadSpec if the object is wrong."""
    if not isinstance(fields, dict):
        raise BadSpec('write one JSON object a line, for example {"car": "red", "fault": "link_drop", "for_s": 2}')
    try:
        kind = FaultKind(str(fields.get("fault")))
    except ValueError:
        raise BadSpec(f"fault {fields.get('fault')!r} is not allowed: use {', '.join(FaultKind)}") from None
    known = _FIELDS[kind]
    _check_words(fields, {"fault", "car"}, set(known), kind)
    given: dict[str, object] = {**known, **fields}
    numbers = {
        word: number(word, given[word], *_RANGES[word])
        for word in known.keys() & _RANGES.keys()
        if (word, given[word]) != ("for_s", None)
    }
    count, path = 0, given.get("path")
    if "bytes" in known:
        low, high = (0, MAX_CUT_BYTES) if kind is FaultKind.CUT_WRITE else (1, MAX_GARBAGE_BYTES)
        count = _whole("bytes", given["bytes"], low, high)
    if path is not None and (not isinstance(path, str) or not path):
        raise BadSpec(f"path {path!r} is not allowed: write the new path of the symlink")
    ways = ["host", "car"] if kind is FaultKind.GARBAGE else list(_WAYS)
    to = _choice("to", given["to"], ways) if "to" in known else "both"
    flood = Flood(_choice("of", given["of"], list(Flood))) if "of" in known else Flood.NOISE
    return Fault(
        kind,
        _car(fields),
        for_s=numbers.get("for_s"),
        bytes=count,
        ways=_WAYS[to],
        factor=numbers.get("factor", 1.0),
        share=numbers.get("share", 0.0),
        rate=numbers.get("rate", 0.0),
        flood=flood,
        path=path,
    )


def press_of(fields: Mapping[str, object]) -> Press:
    """Return the press in a JSON object from the control channel. Raises BadSpec if the object is wrong."""
    _check_words(fields, {"ir", "car"}, set(), "ir")
    return Press(_button(fields.get("ir")), _car(fields))


def _button(word: object) -> Button:
    return Button(_choice("button", word, list(Button)))


def _check_words(fields: Mapping[str, object], own: set[str], known: set[str], what: str) -> None:
    for word in fields.keys() - own - known:
        raise BadSpec(f"field {word!r} is not allowed in {what}: use {', '.join(sorted({'car'} | known))}")


def _car(fields: Mapping[str, object]) -> str | None:
    car = fields.get("car")
    if car is not None and not isinstance(car, str):
        raise BadSpec(f"car {car!r} is not allowed: write a car's name, or leave it out for all")
    return car


def _choice(what: str, value: object, allowed: list[str]) -> str:
    if isinstance(value, str) and value in allowed:
        return value
    raise BadSpec(f"{what} {value!r} is not allowed: use {', '.join(allowed[:-1])} or {allowed[-1]}")


def _whole(what: str, value: object, low: int, high: int) -> int:
    if isinstance(value, float) and math.isfinite(value) and not value.is_integer():
        raise BadSpec(f"{what} {value!r} is not allowed: use a whole number from {low} to {high}")
    return int(number(what, value, low, high))


def number(what: str, value: object, low: float, high: float) -> float:
    """Return a number from the control channel. Raises BadSpec if it is out of range."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise BadSpec(f"{what} {value!r} is not allowed: use a number from {low:.12g} to {high:.12g}")
    return float(value)


_SCHEDULED: Final = re.compile(
    r"(?:(?P<car>[^:@]+):)?(?P<word>[a-z_]+)@(?P<at>\d+(?:\.\d+)?)(?:\+(?P<amount>\d+(?:\.\d+)?))?(?P<more>(?:,[^,]*)*)"
)
_FIELD: Final = re.compile(r"(?P<word>[a-z_]+)=(?P<value>.+)")


def parse_fault(text: str) -> Scheduled:
    """Parse [CAR:]FAULT@SECONDS[+AMOUNT][,FIELD=VALUE...], or raise BadSpec. AMOUNT is `for_s` (garbage: `bytes`)."""
    match = _SCHEDULED.fullmatch(text)
    if match is None:
        raise BadSpec(
            f"fault {text!r} is not allowed: write [CAR:]FAULT@SECONDS[+AMOUNT][,FIELD=VALUE...], for example "
            "red:link_drop@5+2 (gone for 2 s), red:lossy@3+10,share=0.2 (for 10 s), brownout@10"
        )
    fields: dict[str, object] = {"fault": match["word"]}
    if match["car"]:
        fields["car"] = match["car"]
    if match["amount"]:
        if match["word"] == FaultKind.BROWNOUT:
            raise BadSpec(f"fault {text!r} is not allowed: brownout takes no amount")
        fields["bytes" if match["word"] == FaultKind.GARBAGE else "for_s"] = float(match["amount"])
    try:
        for part in match["more"].split(",")[1:]:
            word, value = _field(part)
            _refuse_second(word, fields)
            fields[word] = value
        return Scheduled(_at(match["at"]), fault_of(fields))
    except BadSpec as error:
        raise BadSpec(f"fault {text!r}: {error}") from None


def parse_press(text: str) -> Scheduled:
    """Parse [CAR:]BUTTON@SECONDS. Raises BadSpec if a part is not allowed."""
    match = _SCHEDULED.fullmatch(text)
    if match is None or match["amount"] or match["more"]:
        raise BadSpec(f"ir {text!r} is not allowed: write [CAR:]BUTTON@SECONDS, for example red:forward@5")
    try:
        return Scheduled(_at(match["at"]), Press(_button(match["word"]), match["car"]))
    except BadSpec as error:
        raise BadSpec(f"ir {text!r}: {error}") from None


def _at(text: str) -> float:
    at = float(text)
    if not math.isfinite(at) or at > MAX_FAULT_S:
        raise BadSpec(f"{text} s after the start is not allowed: use at most {MAX_FAULT_S:g}")
    return at


def _refuse_second(word: str, fields: Mapping[str, object]) -> None:
    """Raise BadSpec if the command line has given this field already, or must give it before the `@`."""
    if word in ("car", "fault"):
        raise BadSpec(f"field {word!r} is not allowed: write it before the @")
    if word in fields:
        raise BadSpec(f"{word} is given twice: give it once, as {word}=VALUE or after the +")


def _field(text: str) -> tuple[str, object]:
    pair = _FIELD.fullmatch(text)
    if pair is None:
        raise BadSpec(f"{text!r} is not allowed: write FIELD=VALUE, for example factor=0.1")
    try:
        return pair["word"], float(pair["value"])
    except ValueError:
        return pair["word"], pair["value"]
