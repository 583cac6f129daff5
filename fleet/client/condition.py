"""A condition on the messages that a key expression can match, such as `range_m < 0.3` for `*/sensor/range`.

The condition is checked before the first query. Unknown fields and conditions that can never hold are errors.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Self

from fleet.client.reading import Reading
from fleet.conditions import BadExpression, Expression, compared_in, fields_of, parse, topic_aliases_of
from fleet.conditions.expression import format_literal
from fleet.conditions.fields import LAST
from fleet.conditions.satisfiability import explain_impossible
from schemas import keys, messages, topics
from schemas.bus import intersects
from schemas.suggestion import nearest

_PATTERNS: Final = {
    topic.name: f"*/{topic.name}" if topic.name.startswith("@") else f"*/*/{topic.name}"
    for topic in topics.TOPICS.values()
}
_SERVICES: Final = {topic.family for topic in topics.SERVICE_TOPICS}


def topics_under(written: str) -> list[topics.Topic]:
    """Return the topics that a key expression can match, in the table's order."""
    return [topic for topic in topics.TOPICS.values() if intersects(written, _PATTERNS[topic.name])]


def known_topics_under(written: str) -> list[topics.Topic]:
    """Return the topics that a key expression can match. Raises BadKey with the likely key if there are none."""
    if under := topics_under(written):
        return under
    short = written.partition("/")[2]
    car, _, name = short.partition("/")
    begin = f"{car}/"
    if car.startswith("@"):
        if car not in _SERVICES and not nearest(car, _SERVICES):
            raise keys.BadKey(f"{short}: a key names one car, or all (*), but not a group. For all cars: '*/{name}'.")
        begin, name = "", short
    likely = topics.likely_name(name)
    near = f"Did you mean {begin}{likely}?" if likely else "`fleet keys` lists what is published."
    raise keys.BadKey(f"No key {short}. {near}")


def check_key(written: str) -> str:
    """Return the key expression if it can match a topic or a command. Raises BadKey with the likely key."""
    if "@cmd" not in written.split("/"):
        known_topics_under(written)
    return written


def check_car(name: str) -> str:
    """Return the name of one car. Raises BadKey."""
    if name.startswith("@"):
        raise keys.BadKey(f"{name} is a group, but this needs one car. `fleet.cars()` returns the names of all cars.")
    return keys.check_name(name)


@dataclass(frozen=True, slots=True)
class KeyCondition:
    """A condition on one reading. Each message type that has the fields has its own expression."""

    text: str
    by_message: Mapping[str, Expression]

    @classmethod
    def of(cls, text: str, written: str) -> Self:
        """Parse a condition on the messages under `written`. Raises BadExpression, or BadKey if it matches no topic."""
        under = known_topics_under(written)
        names = {topic.message: fields_of(messages.message_class(topic.message)) for topic in under}
        found: dict[str, Expression] = {}
        never: list[str] = []
        short = {topic.message: topic.name.rpartition("/")[2] for topic in under}
        for message, fields in names.items():
            try:
                found[message] = parse(text, fields, topic_aliases_of(short[message], fields))
                never += filter(None, [explain_impossible(found[message], short[message])])
            except BadExpression:
                if len(names) == 1:
                    raise
        if not found:
            every = {name: kind for fields in names.values() for name, kind in fields.items()}
            aliases = {a: f for message in names for a, f in topic_aliases_of(short[message], names[message]).items()}
            parse(text, {name: every[name] for name in sorted(every, key=LAST.__contains__)}, aliases)
            raise BadExpression(
                text,
                1,
                f"no message under {written} has all of its fields: a condition is about one message",
            )
        if len(never) == len(found):
            raise BadExpression(text, 1, never[0])
        return cls(str(next(iter(found.values()))), found)

    def __str__(self) -> str:
        return self.text

    def holds(self, reading: Reading) -> bool | None:
        """Return True if the condition holds for this reading. None if a field is missing or was not measured."""
        expression = self.by_message.get(reading.value.DESCRIPTOR.full_name)
        return None if expression is None else expression.value(compared_in(reading.value))

    def read(self, reading: Reading) -> list[str]:
        """Return the values that the condition looks at, such as `range_m=0.5`. Empty if the message lacks a field."""
        expression = self.by_message.get(reading.value.DESCRIPTOR.full_name)
        if expression is None:
            return []
        values = {name: compared_in(reading.value)(name) for name in expression.names}
        return [
            f"{name}={'not measured' if value is None else format_literal(value)}" for name, value in values.items()
        ]
