"""A link written into the text of a fleet file, with all else of it, comments too, left as it is. Pure.

The text is cut at the marks of what stands in it, never dumped anew. What comes out is read again: a text that says
anything but the one link otherwise is not given back.
"""

from dataclasses import replace
from pathlib import Path

import yaml

from fleet.fleetfile.fleet_file import FleetFile, parse_fleet
from fleet.fleetfile.scan import key, quoted
from schemas.yaml_document.document import BadFile, Document


class CannotEdit(ValueError):
    """A file that must be changed by hand; the text says what to write."""


def with_link(text: str, path: Path, car: str, link: str) -> str:
    """The text with this link for a car of the file or a new one; raises BadFile for a bad file, and CannotEdit."""
    before = parse_fleet(text, path, unbound=True)
    document = Document(text, str(path))
    cars = document.node(("cars",))
    entry, there = document.node(("cars", car)), document.node(("cars", car, "link"))
    assert isinstance(cars, yaml.MappingNode)  # else the file is a bad one
    if there is not None:
        start, end = there.start_mark.index, there.end_mark.index
        after = f"{text[:start]}{quoted(link)}{text[end:]}"
    elif entry is not None:
        assert isinstance(entry, yaml.MappingNode)
        after = _first(text, entry, f"link: {quoted(link)}")
    else:
        after = _last(text, cars, f"{key(car)}: {{link: {quoted(link)}}}")
    by_hand = CannotEdit(f"{path} cannot be changed here without changing more: write cars.{car}.link: {quoted(link)}")
    try:
        now = parse_fleet(after, path, unbound=True)
    except BadFile as error:
        raise (by_hand if not _clashes(error) else error) from None
    if not _same_but(before, now, car, link):
        raise by_hand
    return after


def _first(text: str, mapping: yaml.MappingNode, entry: str) -> str:
    """The text with an entry before the first of a mapping."""
    if mapping.flow_style:
        inside: int = mapping.start_mark.index + 1
        return text[:inside] + entry + (", " if mapping.value else "") + text[inside:]
    mark = mapping.value[0][0].start_mark
    at: int = mark.index
    return text[:at] + entry + _new_line(text, mark.column) + text[at:]


def _last(text: str, mapping: yaml.MappingNode, entry: str) -> str:
    """The text with an entry after the last of a mapping, and after what is said beside that."""
    if mapping.flow_style:
        at: int = mapping.end_mark.index - 1
        return text[:at] + (", " if mapping.value else "") + entry + text[at:]
    end = text.find("\n", _end(mapping))
    end = len(text) if end < 0 else end - (text[end - 1] == "\r")
    return text[:end] + _new_line(text, mapping.value[0][0].start_mark.column) + entry + text[end:]


def _end(node: yaml.Node) -> int:
    """Where the last value of a node ends: the mark of a block's end is that of what follows it."""
    if isinstance(node, yaml.MappingNode) and not node.flow_style:
        return max(_end(part) for pair in node.value for part in pair)
    if isinstance(node, yaml.SequenceNode) and not node.flow_style:
        return max(map(_end, node.value))
    at: int = node.end_mark.index
    return at


def _new_line(text: str, column: int) -> str:
    return ("\r\n" if "\r\n" in text else "\n") + " " * column


def _clashes(error: BadFile) -> bool:
    """Whether the link itself is refused, not what the cutting made of the text."""
    return all(problem.field.endswith(".link") for problem in error.problems)


def _same_but(before: FleetFile, now: FleetFile, car: str, link: str) -> bool:
    others, others_now = ({name: spec for name, spec in each.cars.items() if name != car} for each in (before, now))
    same = others == others_now and set(before.unbound) - {car} == set(now.unbound)
    rest = [replace(each, cars={}, text="", unlinked={}) for each in (before, now)]
    return same and rest[0] == rest[1] and now.cars[car].link == link
