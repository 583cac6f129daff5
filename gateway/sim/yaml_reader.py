"""Reads the YAML 1.2 text of a world file and reports all faults at once, each with line and column. Pure.

Refuses aliases, tags and deep nesting, so that no small text expands into a large one. `world_file` has the fields.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Final

import yaml
from yamlcore import CoreLoader  # type: ignore[import-untyped]  # has no stubs

from schemas.yaml_document.messages import suggest

MAX_WORLD_BYTES: Final = 64 * 1024
MAX_WORLD_DEPTH: Final = 8
_MAX_FAULTS: Final = 50
"""Maximum of faults in a message."""
_MAX_VALUE_CHARS: Final = 40


class BadWorld(ValueError):
    """A world file with faults. The message has one line per fault: `file:line:column: field: what`."""


class MarkedYaml:
    """A document with its faults so far. A faulty value reads as a default, so that one run finds all faults."""

    def __init__(self, text: str, source: str) -> None:
        self._source = source
        self._problems: list[tuple[int, int, str]] = []
        if len(text.encode(errors="surrogatepass")) > MAX_WORLD_BYTES:
            raise BadWorld(
                f"{source}:1:1: error: the file has more than {MAX_WORLD_BYTES // 1024} KiB, the limit for a world"
            )
        try:
            _check_events(text)
            self._loader = CoreLoader(text)
            root = self._loader.get_single_node()
        except yaml.reader.ReaderError as error:
            line, column = text.count("\n", 0, error.position) + 1, error.position - text.rfind("\n", 0, error.position)
            raise BadWorld(f"{source}:{line}:{column}: error: a character that is not allowed in YAML") from None
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            line, column = (1, 1) if mark is None else (mark.line + 1, mark.column + 1)
            words = " ".join((error.problem or error.context or "it cannot be read").split())
            raise BadWorld(f"{source}:{line}:{column}: error: this YAML is not allowed: {words}") from None
        except ValueError:  # PyYAML's error for a directive such as %YAML 999999…
            raise BadWorld(f"{source}:1:1: error: this is not YAML: a directive has too long a number") from None
        if root is None or (isinstance(root, yaml.ScalarNode) and not root.value):
            raise BadWorld(f"{source}:1:1: error: the file is empty")
        self.root: yaml.Node = root

    @property
    def faulty(self) -> bool:
        """True if there was a fault so far."""
        return bool(self._problems)

    def complain(self, node: yaml.Node, field: str, words: str) -> None:
        """Add a fault."""
        mark = node.start_mark
        self._problems.append((mark.line + 1, mark.column + 1, f"{field}: {words}" if field else words))

    def end(self) -> None:
        """Raise BadWorld if there was a fault."""
        found = sorted(set(self._problems))
        lines = [f"{self._source}:{line}:{column}: error: {words}" for line, column, words in found[:_MAX_FAULTS]]
        if len(found) > _MAX_FAULTS:
            lines.append(f"{self._source}: and {len(found) - _MAX_FAULTS} more")
        if lines:
            raise BadWorld("\n".join(lines))

    def entries(self, node: yaml.Node, field: str) -> dict[str, yaml.Node]:
        """Return a mapping with any names."""
        return {key.value: value for key, value in self._pairs(node, field)}

    def fields(self, node: yaml.Node, field: str, known: Mapping[str, bool]) -> dict[str, yaml.Node]:
        """Return a mapping with known names. `known`: True for a required name."""
        found = {}
        for key, value in self._pairs(node, field):
            if key.value in known:
                found[key.value] = value
            else:
                self.complain(key, _below(field, key.value), f"there is no such field. {suggest(key.value, known)}")
        if isinstance(node, yaml.MappingNode):
            for name, needed in known.items():
                if needed and name not in found:
                    self.complain(node, _below(field, name), "is missing")
        return found

    def _pairs(self, node: yaml.Node, field: str) -> Iterator[tuple[yaml.ScalarNode, yaml.Node]]:
        if not isinstance(node, yaml.MappingNode):
            self.complain(node, field, f"{_display(node)} is not allowed: write fields, `name: value`")
            return
        lines: dict[str, int] = {}
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode) or not key.tag.endswith(":str"):
                self.complain(key, field, f"key {_display(key)} is no word: write it in quotes")
            elif key.value in lines:
                self.complain(key, _below(field, key.value), f"is given twice, first in line {lines[key.value]}")
            else:
                lines[key.value] = key.start_mark.line + 1
                yield key, value

    def items(self, node: yaml.Node, field: str) -> list[tuple[str, yaml.Node]]:
        """Return a list as pairs of the item's field and the item."""
        if not isinstance(node, yaml.SequenceNode):
            self.complain(node, field, f"{_display(node)} is not allowed: write a list")
            return []
        return [(f"{field}[{number}]", each) for number, each in enumerate(node.value)]

    def number(self, node: yaml.Node, field: str, low: float, high: float, *, above: bool = False) -> float:
        """Return a number in a range, without its lower end if `above`. A faulty number reads as the lower end."""
        value = self._scalar(node)
        good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        if good and low <= value <= high and not (above and value == low):  # type: ignore[operator]  # good: a number
            return float(value)  # type: ignore[arg-type]
        ends = f"above {low:g} and up to {high:g}" if above else f"from {low:g} to {high:g}"
        self.complain(node, field, f"{_display(node)} is not allowed: a number {ends}")
        return low if low or not above else high

    def numbers(self, node: yaml.Node, field: str, count: int, low: float, high: float) -> tuple[float, ...] | None:
        """Return a list of `count` numbers. None if it has another length."""
        items = self.items(node, field)
        if isinstance(node, yaml.SequenceNode) and len(items) != count:
            self.complain(node, field, f"has {len(items)} numbers, not {count}")
        if len(items) != count:
            return None
        return tuple(self.number(each, name, low, high) for name, each in items)

    def yes(self, node: yaml.Node, field: str) -> bool:
        """Return True or False; False for any other value."""
        value = self._scalar(node)
        if not isinstance(value, bool):
            self.complain(node, field, f"{_display(node)} is not allowed: true or false")
        return value is True

    def word(self, node: yaml.Node, field: str) -> str:
        """Return a text; empty for any other value."""
        value = self._scalar(node)
        if isinstance(value, str):
            return value
        self.complain(node, field, f"{_display(node)} is not allowed: a name")
        return ""

    def _scalar(self, node: yaml.Node) -> object:
        if not isinstance(node, yaml.ScalarNode):
            return None
        try:
            value: object = self._loader.construct_object(node)
        except (yaml.MarkedYAMLError, ValueError, KeyError, IndexError):  # a number of five thousand digits, `0x`
            return None
        return value


def _below(field: str, name: str) -> str:
    name = name if name.isprintable() and name else repr(name)
    return f"{field}.{name}"[:200] if field else name[:200]


def _display(node: yaml.Node) -> str:
    if isinstance(node, yaml.MappingNode):
        return "a mapping"
    if isinstance(node, yaml.SequenceNode):
        return "a list"
    text = repr(str(node.value))
    return text if len(text) <= _MAX_VALUE_CHARS else f"{text[:_MAX_VALUE_CHARS]}…"


def _check_events(text: str) -> None:
    """Raise yaml.MarkedYAMLError for aliases, tags and deep nesting, before PyYAML composes nodes by recursion."""
    depth = 0
    event: yaml.Event
    for event in yaml.parse(text, yaml.SafeLoader):
        words = ""
        if isinstance(event, yaml.AliasEvent) or (isinstance(event, yaml.NodeEvent) and event.anchor is not None):
            words = "an anchor or alias. Write the value out"
        elif isinstance(event, yaml.ScalarEvent | yaml.CollectionStartEvent) and event.tag not in (None, "!"):
            words = "a tag. Leave it out"
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_WORLD_DEPTH:
            words = f"nested more than {MAX_WORLD_DEPTH} deep"
        if words:
            mark: yaml.Mark | None = event.start_mark  # type: ignore[assignment]  # the stub knows the C parser's, too
            raise yaml.MarkedYAMLError(problem=words, problem_mark=mark)
