"""YAML 1.2 text into a pydantic model: ALL that is wrong with it at once, each fault with its line and column.

Here are the bounds of a file that people write (size, depth, aliases) and the place of each value in it. How a fault is
put into words is `faults`' part; what a fleet file or a plan means is not decided here.
"""

import json
import math
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError
from yamlcore import CoreLoader  # type: ignore[import-untyped]  # has no stubs

from schemas.yaml_document.messages import Where, fault, shown, spelled
from schemas.yaml_document.partial import PartialTree

LARGEST_BYTES: Final = 256 * 1024
"""A fleet of a hundred cars has 20 kB; PyYAML reads about 100 kB in a second."""
DEEPEST: Final = 24
MOST_VALUES: Final = 20_000
"""With every alias written out: nine levels of nine aliases would be 387 million."""
_LARGEST_NUMBER: Final = 2**53
_COLLECTIONS: Final = {yaml.MappingNode: "tag:yaml.org,2002:map", yaml.SequenceNode: "tag:yaml.org,2002:seq"}
_SHOWN: Final = 50
"""No more faults are named than somebody reads."""

_Model = TypeVar("_Model", bound=BaseModel)


@dataclass(frozen=True, slots=True, order=True)
class Problem:
    """One fault of a file. line, column: from 1. field: empty for the file as a whole."""

    line: int
    column: int
    field: str
    words: str

    def __str__(self) -> str:
        return f"{self.line}:{self.column}: " + (f"{self.field}: " if self.field else "") + self.words


class BadFile(ValueError):
    """A file that cannot be used; its text has every fault, one a line: `file:line:column: field: what, allowed`."""

    def __init__(self, source: str, problems: Iterable[Problem]) -> None:
        self.source = source
        self.problems = tuple(sorted(set(problems)))
        lines = [f"{source}:{problem}" for problem in self.problems[:_SHOWN]]
        if len(self.problems) > _SHOWN:
            lines.append(f"{source}: and {len(self.problems) - _SHOWN} more")
        super().__init__("\n".join(lines))


class Entry(BaseModel):
    """What a file's models derive from: unchangeable, and a field that nobody knows is a fault."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def read_marked(text: str, source: str, model: type[_Model]) -> _Model:
    """The model in a text; raises BadFile. `source` is its name in errors, usually the path as the user gave it."""
    document = Document(text, source)
    found = document.take(model)
    document.end()
    assert found is not None  # else there was a problem
    return found


def odd_kind(path: Path) -> str:
    """Return what a path is (`directory`, `FIFO`, ...) that is no regular file; empty if it is one. Raises OSError.

    Call it before opening: a FIFO is waited for, and opening a serial port resets the car on it.
    """
    mode = path.stat().st_mode
    if stat.S_ISREG(mode):
        return ""
    kinds = {stat.S_IFDIR: "directory", stat.S_IFIFO: "FIFO", stat.S_IFSOCK: "socket"}
    return kinds.get(stat.S_IFMT(mode), "device")


def read_text(path: Path, source: str | None = None) -> str:
    """The text of a file; raises BadFile for one that cannot be read, is too large, or is not UTF-8."""
    source = str(path) if source is None else source
    try:
        if kind := odd_kind(path):
            raise BadFile(
                source, [Problem(1, 1, "", f"is a {kind}, not a file: save the text as a file, and give that")]
            )
        with path.open("rb") as file:
            data = file.read(LARGEST_BYTES + 1)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        words = error.strerror if isinstance(error, OSError) else None
        raise BadFile(source, [Problem(1, 1, "", f"cannot be read: {words or error}")]) from None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if len(data) > LARGEST_BYTES:
            raise BadFile(source, [_too_large()]) from None
        line = data.count(b"\n", 0, error.start) + 1
        column = error.start - (data.rfind(b"\n", 0, error.start) + 1) + 1
        words = f"byte 0x{data[error.start]:02x} is no UTF-8: save the file as UTF-8"
        raise BadFile(source, [Problem(line, column, "", words)]) from None


class Document:
    """A text, taken apart: plain data with the place of each value, and the faults found so far.

    Raises BadFile at once if it is no YAML. `tree` is what could be read: None for a value with a fault of its own.
    """

    def __init__(self, text: str, source: str) -> None:
        self.source = source
        self._problems: list[Problem] = []
        self._faulty: set[Where] = set()
        self._places: dict[Where, tuple[yaml.Mark | None, yaml.Node]] = {}
        self._sound = PartialTree(None)
        self._values = 0
        if len(text.encode(errors="surrogatepass")) > LARGEST_BYTES:
            raise BadFile(source, [_too_large()])
        try:
            self._loader = _Loader(text)
            root = self._loader.get_single_node()
        except yaml.reader.ReaderError as error:
            line, column = text.count("\n", 0, error.position) + 1, error.position - text.rfind("\n", 0, error.position)
            words = f"character U+{_code(error.character):04X} is not allowed in YAML"
            raise BadFile(source, [Problem(line, column, "", words)]) from None
        except yaml.MarkedYAMLError as error:
            raise BadFile(source, [_syntax(error)]) from None
        except ValueError:  # what PyYAML makes of a directive such as %YAML 999999…
            raise BadFile(
                source, [Problem(1, 1, "", "is no YAML: a directive with a number that is too long")]
            ) from None
        if root is None or (isinstance(root, yaml.ScalarNode) and not root.value):
            raise BadFile(source, [Problem(1, 1, "", "is empty")])
        self.tree = self._value((), None, root)

    def complain(self, where: Where, words: str, *, on_key: bool = False) -> None:
        """Note a fault of a value (or of its key; or of something missing below the last that is there)."""
        where = self._sound.original(where)
        self._faulty.add(where)
        self._problems.append(self._problem(where, words, on_key=on_key))

    def take(self, model: type[_Model]) -> _Model | None:
        """The document as this model, strictly (no text is a number); None, and its faults noted, if it is not."""
        try:
            return model.model_validate_json(json.dumps(self.tree), strict=True)
        except ValidationError as error:
            self._note(error, model)
            return None

    def take_sound(self, model: type[_Model], missing: Mapping[str, object]) -> _Model | None:
        """The document as this model without its faulty values, after `take` has noted them: to look for other faults.

        `missing`: what stands for a field that has to be there, by name. None: too little is sound.
        """
        dropped, added = set(self._faulty), dict[Where, object]()
        for _ in range(DEEPEST):
            self._sound = PartialTree(self.tree, dropped, added)
            try:
                return model.model_validate_json(json.dumps(self._sound.tree), strict=True)
            except ValidationError as error:
                for where, _, each in self._found(error):
                    if each["type"] == "missing" and where[-1] in missing:
                        added[where] = missing[str(where[-1])]
                    else:
                        dropped.add(where[:-1] if each["type"] == "missing" else where)
            if () in dropped:
                break
        return None

    def faulty_within(self, where: Where) -> bool:
        """Whether a field of what stands there was faulty, so that something else of it may only seem to be."""
        there = self._sound.original(where)
        return any(each[:-1] == there for each in self._faulty if each)

    def is_faulty(self, where: Where) -> bool:
        """Whether what stands there could not be read as it is."""
        return self._sound.original(where) in self._faulty

    def end(self) -> None:
        """Raise BadFile if there was a fault."""
        if self._problems:
            raise BadFile(self.source, self._problems)

    def node(self, where: Where) -> yaml.Node | None:
        """What stands at a place, with its marks: for who edits the text and leaves the rest of it as it is."""
        return self._places[where][1] if where in self._places else None

    def _note(self, error: ValidationError, model: type[BaseModel]) -> None:
        schema = model.model_json_schema()
        heads: dict[tuple[Where, bool, str], list[str]] = {}
        for where, on_key, each in self._found(error):
            if where in self._faulty:
                continue
            head, allowed = fault(each["type"], each, where, schema)
            heads.setdefault((where, on_key, head), []).append(allowed)
        for (where, on_key, head), allowed_words in heads.items():
            allowed = ", or ".join(dict.fromkeys(word for word in allowed_words if word))
            self._problems.append(self._problem(where, f"{head}: {allowed}" if allowed else head, on_key=on_key))
        self._faulty.update(where for where, _, _ in heads)

    def _found(self, error: ValidationError) -> list[tuple[Where, bool, Any]]:
        """Pydantic's errors, each with its place and whether it is one of the key that stands there."""
        found = []
        for each in error.errors(include_url=False):
            where, on_key = self._where(each["loc"], missing=each["type"] == "missing")
            found.append((where, on_key or each["type"] == "extra_forbidden", each))
        # A union's member that the value was not meant to be says nothing when another has looked into the value.
        inner = {where[:depth] for where, _, _ in found for depth in range(len(where))}
        return [each for each in found if each[0] not in inner or not each[2]["type"].endswith("_type")]

    def _where(self, loc: Sequence[str | int], *, missing: bool) -> tuple[Where, bool]:
        """Pydantic's place in the document (its loc names members of unions, too), and whether it is that of a key."""
        where: Where = ()
        for part in loc[:-1] if missing else loc:
            if self._sound.original((*where, part)) in self._places:
                where = (*where, part)
        where = self._sound.original(where)
        if missing:
            where = (*where, loc[-1])
        return where, bool(loc) and loc[-1] == "[key]"

    def _mark(self, where: Where, *, on_key: bool) -> yaml.Mark:
        there = where
        while there not in self._places:
            there = there[:-1]
        key, node = self._places[there]
        return key if key is not None and (on_key or there != where) else node.start_mark

    def _problem(self, where: Where, words: str, *, on_key: bool) -> Problem:
        mark = self._mark(where, on_key=on_key)
        return Problem(mark.line + 1, mark.column + 1, spelled(where), words)

    def _value(self, where: Where, key: yaml.Mark | None, node: yaml.Node) -> Any:
        """Plain data, each alias written out; raises BadFile for more of it than is allowed."""
        self._places[where] = (key, node)
        self._values += 1
        if self._values > MOST_VALUES or len(where) > DEEPEST:
            much = f"nested more than {DEEPEST} deep" if len(where) > DEEPEST else f"more than {MOST_VALUES} values"
            raise BadFile(self.source, [self._problem(where[:3], f"{much}, aliases written out", on_key=True)])
        if isinstance(node, yaml.ScalarNode):
            return self._scalar(where, node)
        assert isinstance(node, yaml.CollectionNode)
        if node.tag != _COLLECTIONS[type(node)]:
            self.complain(where, f"the tag {_tag(node)} is not allowed: leave it out")
            return None
        if isinstance(node, yaml.SequenceNode):
            return [self._value((*where, index), None, each) for index, each in enumerate(node.value)]
        assert isinstance(node, yaml.MappingNode)
        return dict(self._items(where, node))

    def _items(self, where: Where, node: yaml.MappingNode) -> Iterator[tuple[str, Any]]:
        seen: dict[str, int] = {}
        for key_node, value_node in node.value:
            mark = key_node.start_mark
            if not isinstance(key_node, yaml.ScalarNode) or not key_node.tag.endswith(":str"):
                words = f"key {shown(key_node.value)} is no word: write it in quotes, or with a letter first"
                self._problems.append(Problem(mark.line + 1, mark.column + 1, spelled(where), words))
                continue
            name: str = key_node.value
            if name in seen:
                words = f"is given twice, first in line {seen[name]}"
                self._problems.append(Problem(mark.line + 1, mark.column + 1, spelled((*where, name)), words))
                continue
            if not _encodes(name):
                self._problems.append(
                    Problem(mark.line + 1, mark.column + 1, spelled(where), "a key is half a character")
                )
                continue
            seen[name] = mark.line + 1
            yield name, self._value((*where, name), mark, value_node)

    def _scalar(self, where: Where, node: yaml.ScalarNode) -> Any:
        text = shown(node.value)
        try:
            value = self._loader.construct_object(node)
        except yaml.MarkedYAMLError:
            self.complain(where, f"the tag {_tag(node)} is not allowed: leave it out")
        except (ValueError, KeyError, IndexError):  # `!!int zz`, a number of five thousand digits
            self.complain(where, f"{text} is not what its tag says, or too long a number")
        else:
            if isinstance(value, str) and not _encodes(value):
                self.complain(where, f"{text} has half a character (a lone surrogate)")
            elif isinstance(value, float) and not math.isfinite(value):
                self.complain(where, f"{text} is no finite number")
            elif isinstance(value, int) and abs(value) > _LARGEST_NUMBER:
                self.complain(where, f"{text} is too large a number")
            else:
                return value
        return None


class _Loader(CoreLoader):  # type: ignore[misc]  # the class has no stubs
    """YAML 1.2's core schema, no deeper than allowed: PyYAML composes by recursion."""

    def __init__(self, text: str) -> None:
        self._depth = 0
        super().__init__(text)

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """A node with what lies below it."""
        self._depth += 1
        if self._depth > DEEPEST + 1:
            mark = self.peek_event().start_mark
            raise yaml.composer.ComposerError(None, None, f"nested more than {DEEPEST} deep", mark)
        node: yaml.Node | None = super().compose_node(parent, index)
        self._depth -= 1
        return node


def _syntax(error: yaml.MarkedYAMLError) -> Problem:
    mark = error.problem_mark or error.context_mark
    line, column = (1, 1) if mark is None else (mark.line + 1, mark.column + 1)
    problem = " ".join((error.problem or error.context or "it cannot be read").split())
    if "'\\t'" in problem:
        problem = "a tab: YAML is indented with blanks"
    elif "single document" in (error.context or ""):
        problem = "a second document (`---`): a file has one"
    return Problem(line, column, "", f"is no YAML: {problem}")


def _too_large() -> Problem:
    return Problem(1, 1, "", f"has more than {LARGEST_BYTES // 1024} KiB: no file of a fleet needs so much")


def _code(character: str | int) -> int:
    """What PyYAML's error has, which is a number where its stub has a character."""
    return character if isinstance(character, int) else ord(character)


def _encodes(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _tag(node: yaml.Node) -> str:
    return shown(str(node.tag).replace("tag:yaml.org,2002:", "!!"))
