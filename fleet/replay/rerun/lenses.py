"""Rerun lenses that derive tracks, lines of text, curves and arrows from messages.

A lens is a function that Rerun applies to each batch of messages. Ours process the whole batch at once, except for a
few rare texts.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]  # it has no stubs
import pyarrow.compute as pc  # type: ignore[import-untyped]  # likewise
import rerun as rr
import rerun.chunk as rrc

from fleet.replay import panels
from fleet.replay.panels import Curve, Derivation, StateTrack
from schemas.battery_levels import CRITICAL_V, LOW_V
from schemas.topics import TOPICS

MESSAGE_SUFFIX: Final = ":message"
"""Suffix of the component in which Rerun's reader stores a protobuf message."""

TEXT: Final = "TextLog:text"
"""Component to which Rerun's reader converts a foxglove.Log."""
RAW: Final = "McapMessage:data"
"""Component with the bytes of a message that Rerun's reader cannot decode."""

_ARROW_M: Final = 0.25
"""Length of the arrow of a car."""
_POINT: Final = pa.list_(pa.float32(), 3)
"""Rerun's type for points and vectors."""
_Pipe = Callable[[Any], Any]
OTHER_FIELDS: Final = (KeyError, TypeError, AttributeError, pa.ArrowException)
"""Errors that say that the schema of a recording lacks a field, or has it with another type. A recording of another
version may have such a schema. Its messages are shown, without what is derived from that field."""


def component(topic: str) -> str:
    """Return the component with the messages of a topic."""
    return TOPICS[topic].message + MESSAGE_SUFFIX


def is_drawn(topic: str, names: Iterable[str]) -> bool:
    """Return True if a chunk with these components has messages of the type that its topic must have.

    For a topic that is not ours, any type that Rerun decodes will do.
    """
    if topic not in TOPICS:
        return RAW not in names
    return component(topic) in names or (TOPICS[topic].message == "foxglove.Log" and TEXT in names)


def lenses() -> list[Any]:
    """Return one lens for each topic from which something is derived. Curves of plain fields need no lens."""
    derived: dict[str, Any] = {}

    def lens(topic: str) -> Any:
        return derived.get(topic) or rrc.DeriveLens(component(topic))

    for part in panels.parts():
        if (isinstance(part, StateTrack) and not part.drawn) or (
            isinstance(part, Curve) and part.derivation is not None
        ):
            derived[part.topic] = lens(part.topic).to_component(part.name, _selector(part))
    for words in panels.TEXT_LINES:
        line = rrc.Selector(".").pipe(_or_nothing(_line(words.fields, words.before), pa.string()))
        derived[words.topic] = lens(words.topic).to_component(rr.TextLog.descriptor_text(), line, cast_to="auto")
        if words.alarm_field:
            level = rrc.Selector(f".{words.alarm_field}").pipe(_or_nothing(_level(words.calm), pa.string()))
            derived[words.topic] = derived[words.topic].to_component(
                rr.TextLog.descriptor_level(), level, cast_to="auto"
            )
    derived[panels.PLAN_TOPIC] = lens(panels.PLAN_TOPIC).to_component(
        rr.TextDocument.descriptor_text(), ".text", cast_to="auto"
    )
    for topic in (panels.TRUTH, panels.POSE):
        derived[topic] = (
            lens(topic)
            .to_component(
                rr.Arrows3D.descriptor_origins(), rrc.Selector(".").pipe(_or_nothing(_origins, _POINT)), cast_to="auto"
            )
            .to_component(
                rr.Arrows3D.descriptor_vectors(), rrc.Selector(".").pipe(_or_nothing(_vectors, _POINT)), cast_to="auto"
            )
        )
    return list(derived.values())


def triples(x: Any, y: Any) -> Any:
    """Return points on the ground, one row of float32 each. A number that is too large for that becomes infinite."""
    with np.errstate(over="ignore"):
        return np.stack([x, y, np.zeros(len(x))], axis=1).astype("float32")


def numbers(messages: Any, name: str) -> Any:
    """Return a field of a batch of messages as a numpy array."""
    return messages.field(name).to_numpy(zero_copy_only=False)


def _selector(part: StateTrack | Curve) -> Any:
    selector = rrc.Selector(f".{part.field}")
    if part.derivation is None:
        return selector
    kind = pa.float64() if part.derivation in _NUMBERS else pa.string()
    return selector.pipe(_or_nothing(_PIPES[part.derivation], kind))


def _or_nothing(pipe: _Pipe, kind: Any) -> _Pipe:
    """Return a pipe that yields nulls of this type if the messages lack what it needs (OTHER_FIELDS)."""

    def nulls_instead(values: Any) -> Any:
        try:
            return pipe(values)
        except OTHER_FIELDS:
            return pa.nulls(len(values), kind)

    return nulls_instead


def _text_or_nothing(texts: Any) -> Any:
    return pc.if_else(pc.equal(texts, ""), pa.scalar(None, pa.string()), texts)


def _who_and_why(estops: Any) -> Any:
    rows = [", ".join(f"{each['by']}: {each['why']}".rstrip(": ") for each in row or ()) for row in estops.to_pylist()]
    return pa.array([row or None for row in rows], pa.string())


def _total(maps: Any) -> Any:
    return pa.array([float(sum(value for _, value in row or ())) for row in maps.to_pylist()], pa.float64())


def _level_at(voltage_v: float) -> _Pipe:
    return lambda voltages: pa.array(np.full(len(voltages), voltage_v))


_PIPES: Final[dict[Derivation, _Pipe]] = {
    Derivation.TEXT_OR_NOTHING: _text_or_nothing,
    Derivation.WHO_AND_WHY: _who_and_why,
    Derivation.TOTAL: _total,
    Derivation.LOW: _level_at(LOW_V),
    Derivation.CRITICAL: _level_at(CRITICAL_V),
}
_NUMBERS: Final = (Derivation.TOTAL, Derivation.LOW, Derivation.CRITICAL)
"""Derivations that are numbers. The others are text."""


def _line(fields: Sequence[str], before: Mapping[str, str]) -> _Pipe:
    def join(messages: Any) -> Any:
        parts = [_words(messages.field(name)) for name in fields]
        for place, name in enumerate(fields):
            if name in before:
                led = pc.binary_join_element_wise(before[name], parts[place], "")
                parts[place] = pc.if_else(pc.equal(parts[place], ""), "", led)
        joined = pc.binary_join_element_wise(*parts, "  ", null_handling="replace", null_replacement="")
        return pc.utf8_trim_whitespace(pc.replace_substring_regex(joined, r" {3,}", "  "))

    return join


def _words(values: Any) -> Any:
    """Return a field as text: bytes with escapes, roles with their cars."""
    if pa.types.is_binary(values.type):
        try:
            return pc.cast(values, pa.string())
        except pa.ArrowInvalid:
            return pa.array([each.decode(errors="backslashreplace") for each in values.to_pylist()], pa.string())
    if pa.types.is_list(values.type):
        rows = [[f"{role['name']}: {', '.join(role['cars'] or ['nobody'])}" for role in row or ()]
                for row in values.to_pylist()]  # fmt: skip
        return pa.array(["; ".join(row) for row in rows], pa.string())
    return pc.cast(values, pa.string())


def _level(calm: frozenset[str]) -> _Pipe:
    def level(values: Any) -> Any:
        return pc.if_else(pc.is_in(values, pa.array(sorted(calm))), "INFO", "WARN")

    return level


def _fixed(points: Any) -> Any:
    """Return points as fixed-size lists, Rerun's type for vectors."""
    return pa.FixedSizeListArray.from_arrays(pa.array(points.ravel()), 3)


def _origins(poses: Any) -> Any:
    return _fixed(triples(numbers(poses, "x_m"), numbers(poses, "y_m")))


def _vectors(poses: Any) -> Any:
    heading = numbers(poses, "heading_rad")
    with np.errstate(invalid="ignore"):  # an infinite heading has no arrow
        return _fixed(triples(_ARROW_M * np.cos(heading), _ARROW_M * np.sin(heading)))
