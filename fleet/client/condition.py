"""A condition on the messages that a key expression can match, such as `range_m < 0.3` for `*/sensor/range`.

The condition is checked before anything is asked on the bus. Unknown fields are errors, and so are conditions that can
never hold.
"""

from collections.abc import Mapping
from typing import Final, Self

from msgspec import Struct

from fleet.client.reading import Reading
from fleet.conditions import BadExpression, Expression, compared_in, fields_of, parse, topic_aliases_of
from fleet.conditions.expression import format_literal
from fleet.conditions.fields import LAST
from fleet.conditions.satisfiability import explain_impossible
from schemas import keys, messages, topics
from schemas.bus import intersects
from schemas.suggestion import nearest

# Keys of a service are `<fleet>/@recorder/status`: its topic names the service. Others are `<fleet>/<car>/<topic>`.
_PATTERNS: Final = {
    topic.name: f"*/{topic.name}" if topic.name.startswith("@") else f"*/*/{topic.name}"
    for topic in topics.TOPICS.values()
}
_SERVICES: Final = {topic.family for topic in topics.SERVICE_TOPICS}


def topics_under(key_expression: str) -> list[topics.Topic]:
    """Return the topics that a key expression can match, in the order of `topics.TOPICS`."""
    return [topic for topic in topics.TOPICS.values() if intersects(key_expression, _PATTERNS[topic.name])]


def known_topics_under(key_expression: str) -> list[topics.Topic]:
    """Return the topics that a key expression can match. Raises BadKey with the likely key if there are none."""
    if matched := topics_under(key_expression):
        return matched
    short = key_expression.partition("/")[2]  # without the fleet, as people write it
    car, _, name = short.partition("/")
    begin = f"{car}/"
    if car.startswith("@"):
        if car not in _SERVICES and not nearest(car, _SERVICES):
            raise keys.BadKey(f"{short}: a key names one car, or all (*), but not a group. For all cars: '*/{name}'.")
        begin, name = "", short
    likely = topics.likely_name(name)
    near = f"Did you mean {begin}{likely}?" if likely else "`fleet keys` lists what is published."
    raise keys.BadKey(f"No key {short}. {near}")


def check_key(key_expression: str) -> str:
    """Return the key expression if it can match a topic or a command. Raises BadKey with the likely key."""
    if "@cmd" not in key_expression.split("/"):
        known_topics_under(key_expression)
    return key_expression


def check_car(name: str) -> str:
    """Return the name of one car. Raises BadKey."""
    if name.startswith("@"):
        raise keys.BadKey(f"{name} is a group, but this needs one car. `fleet.cars()` returns the names of all cars.")
    return keys.check_name(name)


class KeyCondition(Struct, frozen=True):
    """A condition on one reading. Each message type that has all fields of the condition has its own expression."""

    text: str
    by_message: Mapping[str, Expression]

    @classmethod
    def of(cls, text: str, key_expression: str) -> Self:
        """Parse a condition on the messages that `key_expression` can match.

        Raises BadExpression, or BadKey if it matches no topic.
        """
        matched = known_topics_under(key_expression)
        topic_names = {topic.message: topic.name.rpartition("/")[2] for topic in matched}
        fields_of_message = {message: fields_of(messages.message_class(message)) for message in topic_names}
        found: dict[str, Expression] = {}
        impossible: list[str] = []
        for message, fields in fields_of_message.items():
            try:
                found[message] = parse(text, fields, topic_aliases_of(topic_names[message], fields))
            except BadExpression:
                if len(fields_of_message) == 1:
                    raise
                continue  # another message may have the fields
            impossible += filter(None, [explain_impossible(found[message], topic_names[message])])
        if not found:
            _check_with_all_fields(text, topic_names, fields_of_message)
            words = f"no message under {key_expression} has all of its fields: a condition is about one message"
            raise BadExpression(text, 1, words)
        if len(impossible) == len(found):
            raise BadExpression(text, 1, impossible[0])
        return cls(str(next(iter(found.values()))), found)

    def __str__(self) -> str:
        return self.text

    def holds(self, reading: Reading) -> bool | None:
        """Return True if the condition holds for this reading. None if a missing value leaves that open."""
        expression = self.by_message.get(reading.value.DESCRIPTOR.full_name)
        return None if expression is None else expression.value(compared_in(reading.value))

    def describe_values(self, reading: Reading) -> list[str]:
        """Return the values that the condition looks at, such as `range_m=0.5`. Empty if the message lacks a field."""
        expression = self.by_message.get(reading.value.DESCRIPTOR.full_name)
        if expression is None:
            return []
        values = {name: compared_in(reading.value)(name) for name in expression.names}
        return [
            f"{name}={'not measured' if value is None else format_literal(value)}" for name, value in values.items()
        ]


def _check_with_all_fields(
    text: str, topic_names: Mapping[str, str], fields_of_message: Mapping[str, Mapping[str, type]]
) -> None:
    """Raise BadExpression if the syntax is wrong, or if a field is in no message at all."""
    fields = {name: kind for each in fields_of_message.values() for name, kind in each.items()}
    aliases: dict[str, str] = {}
    for message, each in fields_of_message.items():
        aliases |= topic_aliases_of(topic_names[message], each)
    # The error lists the names in this order, so put the fields that all messages have (`LAST`) at the end.
    parse(text, {name: fields[name] for name in sorted(fields, key=LAST.__contains__)}, aliases)
