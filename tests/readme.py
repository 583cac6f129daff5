"""The generated parts of README.md: `python -m tests.readme` writes them, tests/test_readme.py compares them."""

import subprocess
import sys
from pathlib import Path

from google.protobuf.descriptor import FieldDescriptor

from schemas import messages, topics

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
_COMMON = {"sender", "kind", "id", "asked", "take", "ttl_s"}
_ABOUT = {
    "drive": "hold a motion for `duration_s` (0.5 s by default, at most 10), then stop",
    "mode": "bring the car into a mode; `manual` closes whatever is open",
    "led": "the colour LED, 0..255 each",
    "light": "the light's colour, or `off`",
    "servo": "move a servo a step, or the front one to `deg` (0..180)",
    "arm": "six joints, 0..180 degrees each (option `+arm`)",
    "whistle": "sound once",
    "speed": "one step `up` or `down`: cars know no absolute speed",
    "fan": "toggle; `on` or `off` while its state is known",
    "stop": "stop, and hold the car against the coordinator",
    "estop": "as stop; this version latches nothing",
    "resume": "end the hold",
    "lease": "not in this version",
    "find": "blink and beep, without moving",
}


def topic_table() -> str:
    """The table of topics, from the table that the code runs on."""
    rows = ["| key | message | what | units | stale after |", "|---|---|---|---|---|"]
    for topic in topics.TOPICS.values():
        units = ", ".join(f"{name} {unit}" for name, unit in topic.units.items()) or "-"
        stale = f"{topic.stale_after_s:g} s" if topic.stale_after_s is not None else "-"
        key = topic.name if topic.name.startswith("@") else f"<car>/{topic.name}"
        rows.append(f"| `fleet/{key}` | {topic.message} | {topic.about} | {units} | {stale} |")
    return "\n".join(rows)


def verb_table() -> str:
    """The table of commands, with the fields of each message."""
    rows = ["| verb | fields | what |", "|---|---|---|"]
    for verb, name in topics.COMMANDS.items():
        fields = messages.message_class(name).DESCRIPTOR.fields
        own = [_field(field) for field in fields if field.name not in _COMMON]
        rows.append(f"| `{verb}` | {', '.join(own) or '-'} | {_ABOUT[verb]} |")
    return "\n".join(rows)


def _field(field: FieldDescriptor) -> str:
    return f"`{field.name}`" + ("..." if field.is_repeated else "")


def help_text() -> str:
    """What `fleet --help` and `gateway --help` print."""
    shown = []
    for program, module in (("fleet", "fleet.cli"), ("gateway", "gateway.cli")):
        done = subprocess.run(
            [sys.executable, "-m", module, "--help"],
            capture_output=True,
            text=True,
            check=True,
            cwd=ROOT,
            env={"COLUMNS": "110", "PATH": "/usr/bin:/bin", "NO_COLOR": "1"},
        )
        shown.append(f"$ {program} --help\n{done.stdout.strip()}".replace(f"python -m {module}", program))
    return "```\n" + "\n\n".join(shown) + "\n```"


def any_client() -> str:
    """The script that needs none of our code; tests/e2e runs it."""
    return "```python\n" + (ROOT / "tests" / "e2e" / "any_client.py").read_text(encoding="utf-8").strip() + "\n```"


PARTS = {"topics": topic_table, "verbs": verb_table, "help": help_text, "any_client": any_client}


def generated(text: str) -> str:
    """`text` with every generated part made anew."""
    for name, make in PARTS.items():
        begin, end = f"<!-- begin: {name} -->", f"<!-- end: {name} -->"
        before, found, rest = text.partition(begin)
        _, closed, after = rest.partition(end)
        assert found, f"README.md has no {begin}"
        assert closed, f"README.md has no {end}"
        text = f"{before}{begin}\n{make()}\n{end}{after}"
    return text


if __name__ == "__main__":
    README.write_text(generated(README.read_text(encoding="utf-8")), encoding="utf-8")
