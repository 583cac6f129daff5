"""Writes a link into the text of a fleet file. Everything else, including comments, stays as it is. Pure.

The editor inserts the link into the text, at the position that the YAML parser gives, and never writes the whole YAML
again. It parses the result, and refuses it if anything except the link has changed.
"""

from pathlib import Path

import yaml
from msgspec.structs import replace

from fleet.fleetfile.fleet_file import FleetFile, parse_fleet
from fleet.fleetfile.template import format_key, quote
from schemas.yaml_document.document import BadFile, Document


class CannotEdit(ValueError):
    """The file must be edited by hand. The text says what to write."""


def set_link(text: str, path: Path, car: str, link: str) -> str:
    """Return the text with this link for a listed or a new car. Raises BadFile or CannotEdit if it cannot be done."""
    before = parse_fleet(text, path, unbound=True)
    document = Document(text, str(path))
    cars = document.node(("cars",))
    entry, link_node = document.node(("cars", car)), document.node(("cars", car, "link"))
    assert isinstance(cars, yaml.MappingNode)  # parse_fleet would have raised BadFile otherwise
    if link_node is not None:
        start, end = link_node.start_mark.index, link_node.end_mark.index
        after = f"{text[:start]}{quote(link)}{text[end:]}"
    elif entry is not None:
        assert isinstance(entry, yaml.MappingNode)
        after = _insert_first(text, entry, f"link: {quote(link)}")
    else:
        after = _insert_last(text, cars, f"{format_key(car)}: {{link: {quote(link)}}}")
    by_hand = CannotEdit(
        f"{path}: the link cannot be inserted without changing other parts of the file. Edit it by hand: set "
        f"cars.{car}.link to {quote(link)}"
    )
    try:
        now = parse_fleet(after, path, unbound=True)
    except BadFile as error:
        raise (by_hand if not _is_about_links(error) else error) from None
    if not _differs_only_in(before, now, car, link):
        raise by_hand
    return after


def _insert_first(text: str, mapping: yaml.MappingNode, entry: str) -> str:
    """Insert an entry before the first entry of a mapping."""
    if mapping.flow_style:
        inside: int = mapping.start_mark.index + 1
        return text[:inside] + entry + (", " if mapping.value else "") + text[inside:]
    mark = mapping.value[0][0].start_mark
    at: int = mark.index
    return text[:at] + entry + _new_line(text, mark.column) + text[at:]


def _insert_last(text: str, mapping: yaml.MappingNode, entry: str) -> str:
    """Insert an entry after the last entry of a mapping, and after a comment on the same line."""
    if mapping.flow_style:
        at: int = mapping.end_mark.index - 1
        return text[:at] + (", " if mapping.value else "") + entry + text[at:]
    end = text.find("\n", _end_of(mapping))
    end = len(text) if end < 0 else end - (text[end - 1] == "\r")
    return text[:end] + _new_line(text, mapping.value[0][0].start_mark.column) + entry + text[end:]


def _end_of(node: yaml.Node) -> int:
    """Return the end of a node's last value. PyYAML's end mark of a block is the start of the next node."""
    if isinstance(node, yaml.MappingNode) and not node.flow_style:
        return max(_end_of(part) for pair in node.value for part in pair)
    if isinstance(node, yaml.SequenceNode) and not node.flow_style:
        return max(map(_end_of, node.value))
    at: int = node.end_mark.index
    return at


def _new_line(text: str, column: int) -> str:
    return ("\r\n" if "\r\n" in text else "\n") + " " * column


def _is_about_links(error: BadFile) -> bool:
    """Return True if all faults are about links. Otherwise the insertion has broken the text."""
    return all(problem.field.endswith(".link") for problem in error.problems)


def _differs_only_in(before: FleetFile, now: FleetFile, car: str, link: str) -> bool:
    others, others_now = ({name: spec for name, spec in each.cars.items() if name != car} for each in (before, now))
    same = others == others_now and set(before.unbound) - {car} == set(now.unbound)
    rest = [replace(each, cars={}, text="", unlinked={}) for each in (before, now)]
    return same and rest[0] == rest[1] and now.cars[car].link == link
