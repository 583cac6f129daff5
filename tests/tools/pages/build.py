"""The table of generated parts and pages, and the text that each page should have."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Final

from tests.tools.pages import command_line, files, proto, python_api, tables

ROOT: Final = Path(__file__).parents[3]
DOCS: Final = ROOT / "docs"
CLI: Final = DOCS / "reference/cli"
_NUMBER: Final = re.compile(r"(<!-- n: (\w+) -->).*?(<!-- /n -->)")


def _program(path: str) -> str:
    return f"```python\n{(ROOT / path).read_text(encoding='utf-8').strip()}\n```"


def any_client() -> str:
    """Return the script that needs none of our code; tests/e2e runs it."""
    return _program("tests/e2e/any_client.py")


def drive_one() -> str:
    """Return the first example; tests/fleet/test_examples.py runs it."""
    return _program("fleet/examples/programs/drive_one.py")


def tank() -> str:
    """Return the driver of another package; tests/gateway/drivers/test_check.py checks it."""
    return _program("tests/support/tank.py")


PARTS: Final[dict[str, tuple[str, Callable[[], str]]]] = {
    "topics": ("docs/reference/keys.md", tables.key_table),
    "messages": ("docs/reference/messages.md", proto.message_tables),
    "verbs": ("docs/reference/commands.md", tables.verb_table),
    "conditions": ("docs/reference/conditions.md", tables.condition_table),
    "reports": ("docs/reference/modes.md", tables.report_table),
    "verdicts": ("docs/reference/modes.md", tables.mode_table),
    "stops": ("docs/reference/stopping-times.md", tables.stop_table),
    "evidence": ("docs/reference/stop-evidence.md", tables.evidence_table),
    "trust": ("docs/reference/stop-evidence.md", tables.trust_table),
    "transitions": ("docs/reference/stop-evidence.md", tables.transition_table),
    "platforms": ("docs/reference/platforms.md", tables.platform_table),
    "fleet file": ("docs/reference/fleet-file.md", lambda: files.schema_tables(files.fleet_schema())),
    "plan": ("docs/reference/plan-file.md", lambda: files.schema_tables(files.plan_schema())),
    "world": ("docs/reference/world-file.md", lambda: files.schema_tables(files.world_schema())),
    "metrics": ("docs/how-to/watch-with-prometheus.md", tables.metric_table),
    "entities": ("docs/how-to/show-in-home-assistant.md", tables.entity_table),
    "any_client": ("docs/how-to/use-any-zenoh-client.md", any_client),
    "tank": ("docs/how-to/write-a-driver.md", tank),
    "drive_one": ("docs/how-to/drive-from-python.md", drive_one),
}
"""Generated parts of pages: the page, and the function that makes the part."""


def expected() -> dict[Path, str]:
    """Return the expected text of each page with generated parts."""
    made = {path: path.read_text(encoding="utf-8") for path in sorted(DOCS.rglob("*.md")) if path.parent != CLI}
    made = {path: text for path, text in made.items() if "<!-- begin:" in text or "<!-- n:" in text}
    for name, (page, make) in PARTS.items():
        made[ROOT / page] = _replaced(made.get(ROOT / page, ""), name, make(), page)
    values = tables.numbers()
    made = {
        path: _NUMBER.sub(lambda match: f"{match[1]}{values[match[2]]}{match[3]}", text) for path, text in made.items()
    }
    made[ROOT / "docs/reference/python.md"] = python_api.reference()
    return made | {CLI / name: text for name, text in command_line.pages().items()}


def stale_pages() -> list[Path]:
    """Return the pages of commands that are gone."""
    return [path for path in CLI.glob("*.md") if path.name not in command_line.pages()]


def _replaced(text: str, name: str, part: str, page: str) -> str:
    begin, end = f"<!-- begin: {name} -->", f"<!-- end: {name} -->"
    before, found, rest = text.partition(begin)
    _, closed, after = rest.partition(end)
    assert found, f"{page} has no {begin}"
    assert closed, f"{page} has no {end}"
    return f"{before}{begin}\n\n{part}\n\n{end}{after}"
