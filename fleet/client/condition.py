"""A condition over the messages that a key expression can match: `range_m < 0.3` of `*/sensor/range`.

Understood before anything is asked: a field that no message there has is an error, and so is what can never be true.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Self

from fleet.client.reading import Reading
from fleet.conditions import BadExpression, Expression, fields_of, parse, value_in
from fleet.conditions.expression import format_literal
from fleet.conditions.fields import LAST
from fleet.conditions.satisfiability import explain_impossible
from schemas import keys, messages, topics
from schemas.bus import intersects

_PATTERNS: Final = {
    topic.name: f"*/{topic.name}" if topic.name.startswith("@") else f"*/*/{topic.name}"
    for topic in topics.TOPICS.values()
}


def topics_under(written: str) -> list[topics.Topic]:
    """The topics that a written-out key expression can match, in the table's order."""
    return [topic for topic in topics.TOPICS.values() if intersects(written, _PATTERNS[topic.name])]


@dataclass(frozen=True, slots=True)
class KeyCondition:
    """What must hold of one reading; each type of message that has the fields has its own expression."""

    text: str
    by_message: Mapping[str, Expression]

    @classmethod
    def of(cls, text: str, written: str) -> Self:
        """Understand a condition over what `written` can match; raises BadExpression, BadKey (nothing is there)."""
        under = topics_under(written)
        if not under:
            there = ", ".join(topics.TOPICS)
            raise keys.BadKey(
                f"nothing is ever published under {written}, so no condition can hold; topics are {there}"
            )
        names = {topic.message: fields_of(messages.message_class(topic.message)) for topic in under}
        found: dict[str, Expression] = {}
        never: list[str] = []
        short = {topic.message: topic.name.rpartition("/")[2] for topic in under}
        for message, fields in names.items():
            try:
                found[message] = parse(text, fields)
                never += filter(None, [explain_impossible(found[message], short[message])])
            except BadExpression:
                if len(names) == 1:
                    raise
        if not found:
            every = {name: kind for fields in names.values() for name, kind in fields.items()}
            parse(text, {name: every[name] for name in sorted(every, key=LAST.__contains__)})
            raise BadExpression(text, 1, f"no message under {written} has all of its fields: it is about one message")
        if len(never) == len(found):
            raise BadExpression(text, 1, never[0])
        return cls(str(next(iter(found.values()))), found)

    def __str__(self) -> str:
        return self.text

    def holds(self, reading: Reading) -> bool | None:
        """Whether it holds of this reading; None: its message has no such field, or it was not measured."""
        expression = self.by_message.get(reading.value.DESCRIPTOR.full_name)
        return None if expression is None else expression.value(value_in(reading.value))

    def read(self, reading: Reading) -> list[str]:
        """What it reads in a message, as `range_m=0.5`; nothing, if the message has not what it is about."""
        expression = self.by_message.get(reading.value.DESCRIPTOR.full_name)
        if expression is None:
            return []
        values = {name: value_in(reading.value)(name) for name in expression.names}
        return [
            f"{name}={'not measured' if value is None else format_literal(value)}" for name, value in values.items()
        ]
