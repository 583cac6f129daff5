"""The fields of every message, from the comments in schemas/proto."""

import re
from dataclasses import dataclass, field
from pathlib import Path

from schemas import topics
from schemas.commands import COMMANDS
from tests.tools.pages.command_line import cell, escape

PROTO = Path(__file__).parents[3] / "schemas/proto/fleet_v1.proto"
COMMON = frozenset({"stamp", "car", "seq", "boot_id"})
COMMON_OF_COMMANDS = frozenset({"sender", "kind", "id", "asked", "take", "ttl_s"})
_FIELD = re.compile(r"  (optional |repeated )?(map<[^>]+>|[\w.]+) (\w+) = \d+;(?:\s*// (.*))?")
_NEXT_LINE = re.compile(r"\s+// (.*)")
"""A further line of a field's comment."""


@dataclass
class ProtoMessage:
    """A message of the .proto file: its comment, and its fields with type and comment."""

    name: str
    about: str
    fields: list[tuple[str, str, str]] = field(default_factory=list)


def read() -> list[ProtoMessage]:
    """Return every message of the file, in its order."""
    found: list[ProtoMessage] = []
    comment: list[str] = []
    for line in PROTO.read_text(encoding="utf-8").splitlines():
        if begin := re.match(r"message (\w+) \{(\})?", line):
            found.append(ProtoMessage(begin[1], " ".join(comment)))
        elif (each := _FIELD.match(line)) and found:
            label, kind, name, words = each[1] or "", each[2], each[3], each[4] or ""
            found[-1].fields.append((name, f"{label}{kind.removeprefix('google.protobuf.')}", words))
        elif (more := _NEXT_LINE.match(line)) and found:
            name, kind, words = found[-1].fields[-1]
            found[-1].fields[-1] = name, kind, f"{words} {more[1]}"
        comment = [*comment, line.removeprefix("//").strip()] if line.startswith("// ") and "----" not in line else []
    return found


def message_tables() -> str:
    """Return a section for each message with its own fields, type, unit and meaning."""
    by_message = {topic.message: topic for topic in topics.TOPICS.values()}
    commands = {row.message: f"The command `{verb}`: {row.about}" for verb, row in COMMANDS.items()}
    parts = []
    for message in read():
        topic = by_message.get(f"fleet.v1.{message.name}")
        is_command = message.name.endswith("Command")
        left_out = COMMON_OF_COMMANDS if is_command else COMMON if topic else frozenset()
        fields = [each for each in message.fields if each[0] not in left_out]
        under = f"Under `{topic.name}`." if topic else ""
        words = message.about or commands.get(f"fleet.v1.{message.name}", "")
        about = f"{words[:1].upper()}{words[1:].rstrip('.')}." if words else ""
        lines = [f"### {message.name}", " ".join(part for part in (under, escape(about)) if part)]
        if fields:
            rows = ["| field | type | unit | what |", "|---|---|---|---|"]
            for name, kind, words in fields:
                unit = (topic.units.get(name, "") if topic else "") or _unit(name)
                rows.append(f"| `{name}` | {escape(kind)} | {unit} | {cell(words.removeprefix(unit + ', '))} |")
            lines.append("\n".join(rows))
        elif is_command:
            lines.append("It has only the common fields of commands.")
        parts.append("\n\n".join(line for line in lines if line))
    return "\n\n".join(parts)


def _unit(name: str) -> str:
    """Return the unit that the name of a field ends with."""
    ends = {"_s": "s", "_m": "m", "_v": "V", "_deg": "deg", "_rad": "rad", "_mb": "MB", "_bytes": "B", "_m_s": "m/s"}
    return next((unit for end, unit in sorted(ends.items(), key=lambda each: -len(each[0])) if name.endswith(end)), "")
