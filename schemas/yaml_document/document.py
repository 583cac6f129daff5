"""Reads YAML 1.2 text into a pydantic model and reports all faults at once, each with line and column.

It limits size, depth and aliases. fault_words.py puts faults into words. The meaning of a fleet file or a plan is
checked in the packages of those files.
"""

import codecs
import json
import math
import re
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, TypeVar

import yaml
from msgspec import Struct
from pydantic import BaseModel, ConfigDict, ValidationError
from yamlcore import CoreLoader  # type: ignore[import-untyped]  # has no stubs

from schemas.picklable import Picklable
from schemas.suggestion import did_you_mean
from schemas.yaml_document.fault_words import Where, describe_error, format_place, quote_value
from schemas.yaml_document.partial import PartialTree

MAX_YAML_BYTES: Final = 256 * 1024
"""Maximum size of a file. A fleet of a hundred cars has 20 kB; PyYAML reads about 100 kB per second."""
MAX_YAML_DEPTH: Final = 24
MAX_YAML_VALUES: Final = 20_000
"""Maximum number of values with all aliases expanded: nine levels of nine aliases would make 387 million."""
_MAX_INTEGER: Final = 2**53
"""Up to this, a float has every integer exactly. JSON readers may use floats for all numbers (JavaScript does)."""
_TOO_LARGE: Final = f"the file has more than {MAX_YAML_BYTES // 1024} KiB, which is the limit"
_COLLECTIONS: Final = {yaml.MappingNode: "tag:yaml.org,2002:map", yaml.SequenceNode: "tag:yaml.org,2002:seq"}
_MAX_PROBLEMS_LISTED: Final = 50
"""Maximum faults in an error message."""

_COLOR_COMMENT: Final = re.compile(r"[:,[][ \t]*(#[0-9A-Fa-f]{6})\b")
"""A color without quotes, which YAML reads as a comment."""

_Model = TypeVar("_Model", bound=BaseModel)


class Problem(Struct, frozen=True, order=True):
    """One fault of a file. `line` and `column` count from 1; both are 0 if there is no file. `field` may be empty."""

    line: int
    column: int
    field: str
    words: str

    def __str__(self) -> str:
        return (
            (f"{self.line}:{self.column}:" if self.line else "")
            + " error: "
            + (f"{self.field}: " if self.field else "")
            + self.words
        )


class BadFile(Picklable, ValueError):
    """A file that cannot be used. The text has one line for each of the first 50 faults.

    Such a line is `file:line:column: error: field: what`.
    """

    def __init__(self, source: str, problems: Iterable[Problem]) -> None:
        self.source = source
        self.problems = tuple(sorted(set(problems)))
        lines = [f"{source}:{problem}" for problem in self.problems[:_MAX_PROBLEMS_LISTED]]
        if len(self.problems) > _MAX_PROBLEMS_LISTED:
            rest = self.problems[_MAX_PROBLEMS_LISTED:]
            lines.append(f"{source}:{rest[0].line}:{rest[0].column}: error: and {len(rest)} more")
        super().__init__("\n".join(lines))


def _bad_file(source: str, words: str, line: int = 1, column: int = 1) -> BadFile:
    return BadFile(source, [Problem(line, column, "", words)])


class Entry(BaseModel):
    """Base class of a file's models: frozen, and unknown fields are faults."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def schema_of(model: type[BaseModel], title: str) -> dict[str, Any]:
    """Return the JSON Schema of a file, for editors."""
    made = _without_titles(model.model_json_schema())
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title, **made}


def _without_titles(part: Any) -> Any:
    """Remove the titles that pydantic makes from names, because editors would show them instead of descriptions."""
    if isinstance(part, list):
        return [_without_titles(each) for each in part]
    if not isinstance(part, dict):
        return part
    return {name: _without_titles(each) for name, each in part.items() if name != "title" or not isinstance(each, str)}


def name_special_file(path: Path) -> str:
    """Name the type of a path that is not a regular file (`directory`, `FIFO`, ...). Empty if it is one.

    Call it before opening the path: opening a FIFO blocks, and opening a serial port resets the car on it.
    """
    mode = path.stat().st_mode
    if stat.S_ISREG(mode):
        return ""
    kinds = {stat.S_IFDIR: "directory", stat.S_IFIFO: "FIFO", stat.S_IFSOCK: "socket"}
    return kinds.get(stat.S_IFMT(mode), "device")


def _suggest_file(path: Path) -> str:
    """Return `Did you mean fleet.yaml?` for a likely file of the same directory. Empty if there is none."""
    with suppress(OSError):
        names = sorted(each.name for each in path.parent.iterdir() if each.suffix == ".yaml" and each.exists())
        return did_you_mean(path.name, names)
    return ""


def read_text(path: Path, source: str | None = None) -> str:
    """Read the text of a file. Raises BadFile if it cannot be read, or is not UTF-8.

    Of a file that is too large, return only the beginning: one byte more than `Document` accepts.
    """
    source = str(path) if source is None else source
    try:
        kind = name_special_file(path)
        data = b"" if kind else _read_start(path)
    except FileNotFoundError:
        raise _bad_file(source, f"there is no such file. {_suggest_file(path)}".rstrip(" ."), 0, 0) from None
    except OSError as error:
        raise _bad_file(source, f"cannot be read: {error.strerror or error}") from None
    except ValueError as error:  # a NUL in the path
        raise _bad_file(source, f"cannot be read: {error}") from None
    if kind:
        raise _bad_file(source, f"is a {kind}, not a file: save the text as a file, and give that file")
    if len(data) > MAX_YAML_BYTES and data.startswith(codecs.BOM_UTF8):
        raise _bad_file(source, _TOO_LARGE)  # without its mark, the beginning would look like a whole file
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if len(data) > MAX_YAML_BYTES:  # the read may have cut a character in two
            raise _bad_file(source, _TOO_LARGE) from None
        line = data.count(b"\n", 0, error.start) + 1
        column = error.start - (data.rfind(b"\n", 0, error.start) + 1) + 1
        words = f"byte 0x{data[error.start]:02x} is not UTF-8. Save the file as UTF-8."
        raise _bad_file(source, words, line, column) from None


def _read_start(path: Path) -> bytes:
    """Return a file's bytes, at most one more than a file may have."""
    with path.open("rb") as file:
        return file.read(MAX_YAML_BYTES + 1)


class Document:
    """A YAML text as plain data with the place of each value, and the faults found so far.

    Raises BadFile at once if the text is not YAML, empty or too large. `tree` is the data, with None for each value
    that YAML alone shows to be faulty.
    """

    def __init__(self, text: str, source: str) -> None:
        self.source = source
        self._problems: list[Problem] = []
        self._faulty: set[Where] = set()
        self._places: dict[Where, tuple[yaml.Mark | None, yaml.Node]] = {}
        self._partial = PartialTree(None)  # of the last `validate_partial`: translates its places to those of the text
        self._value_count = 0
        self.tree: Any = None
        if len(text.encode(errors="surrogatepass")) > MAX_YAML_BYTES:
            raise _bad_file(source, _TOO_LARGE)
        try:
            self._loader = _Loader(text)
            root = self._loader.get_single_node()
        except yaml.reader.ReaderError as error:
            line, column = text.count("\n", 0, error.position) + 1, error.position - text.rfind("\n", 0, error.position)
            code = error.character if isinstance(error.character, int) else ord(error.character)
            words = f"character U+{code:04X} is not allowed in YAML"
            raise _bad_file(source, words, line, column) from None
        except yaml.MarkedYAMLError as error:
            raise BadFile(source, [_syntax_problem(error)]) from None
        except ValueError:  # from PyYAML for a directive such as %YAML 999999…
            raise _bad_file(source, "this is not YAML: a directive has too long a number") from None
        if root is None or (isinstance(root, yaml.ScalarNode) and not root.value):
            raise _bad_file(source, "the file is empty")
        self.tree = self._construct((), None, root)

    def report(self, where: Where, words: str, *, on_key: bool = False) -> None:
        """Add a fault of a value, of its key, or of a missing field."""
        where = self._partial.original(where)
        self._faulty.add(where)
        self._problems.append(self._problem_at(where, words, on_key=on_key))

    def validate(self, model: type[_Model]) -> _Model | None:
        """Return the document as this model, or None after adding its faults. Text is never read as a number."""
        try:
            return model.model_validate_json(json.dumps(self.tree), strict=True)
        except ValidationError as error:
            self._add_problems(error, model)
            return None

    def validate_partial(self, model: type[_Model], missing: Mapping[str, object]) -> _Model | None:
        """Return the document as this model without its faulty values, so that other faults can be found.

        Call it after `validate`. `missing` has values for missing required fields. Returns None if too little remains.
        """
        dropped, added = set(self._faulty), dict[Where, object]()
        # Without a faulty value, the value around it may be faulty in turn. So this can take one round for each level.
        for _ in range(MAX_YAML_DEPTH):
            self._partial = PartialTree(self.tree, dropped, added)
            try:
                return model.model_validate_json(json.dumps(self._partial.tree), strict=True)
            except ValidationError as error:
                for where, _on_key, each in self._locate(error):
                    if each["type"] != "missing":
                        dropped.add(where)
                    elif where[-1] in missing:
                        added[where] = missing[str(where[-1])]
                    else:
                        dropped.add(where[:-1])
            if () in dropped:
                break
        return None

    def faulty_within(self, where: Where) -> bool:
        """Return True if a field at this place is faulty. Other faults there may be only consequences of it."""
        place = self._partial.original(where)
        return any(each[:-1] == place for each in self._faulty if each)

    def is_faulty(self, where: Where) -> bool:
        """Return True if the value at this place is faulty."""
        return self._partial.original(where) in self._faulty

    def raise_faults(self) -> None:
        """Raise BadFile if there are faults."""
        if self._problems:
            raise BadFile(self.source, self._problems)

    def node(self, where: Where) -> yaml.Node | None:
        """Return the YAML node at a place, with its marks, for edits of the text."""
        return self._places[where][1] if where in self._places else None

    def _add_problems(self, error: ValidationError, model: type[BaseModel]) -> None:
        schema = model.model_json_schema()
        allowed_of: dict[tuple[Where, bool, str], list[str]] = {}  # each member of a union allows something else
        for where, on_key, each in self._locate(error):
            if where in self._faulty:
                continue
            fault, allowed = describe_error(each["type"], each, where, schema)
            allowed_of.setdefault((where, on_key, fault), []).append(allowed)
        for (where, on_key, fault), each_allowed in allowed_of.items():
            allowed = " ".join(dict.fromkeys(words for words in each_allowed if words))
            self._problems.append(self._problem_at(where, f"{fault}. {allowed}" if allowed else fault, on_key=on_key))
        self._faulty.update(where for where, _on_key, _fault in allowed_of)

    def _locate(self, error: ValidationError) -> list[tuple[Where, bool, Any]]:
        """Return pydantic's errors, each with its place, and True if it is about the key there."""
        errors = []
        for each in error.errors(include_url=False):
            where, on_key = self._place_of(each["loc"], missing=each["type"] == "missing")
            errors.append((where, on_key or each["type"] == "extra_forbidden", each))
        # A value of a union gets errors from each member. "Wrong type" from one member is noise if another member
        # accepts the type and reports only another fault of the value, or a fault inside it.
        accepted = {where[:depth] for where, _, _ in errors for depth in range(len(where))}
        accepted |= {where for where, _, each in errors if not each["type"].endswith("_type")}
        return [each for each in errors if each[0] not in accepted or not each[2]["type"].endswith("_type")]

    def _place_of(self, loc: Sequence[str | int], *, missing: bool) -> tuple[Where, bool]:
        """Return the place of pydantic's loc (which also names members of unions), and True if it is a key's place."""
        where: Where = ()
        for part in loc[:-1] if missing else loc:
            if self._partial.original((*where, part)) in self._places:
                where = (*where, part)
        where = self._partial.original(where)
        if missing:
            where = (*where, loc[-1])
        return where, bool(loc) and loc[-1] == "[key]"

    def position(self, where: Where, *, on_key: bool = False) -> tuple[int, int]:
        """Return line and column of a value, or of its key, from 1."""
        mark = self._mark_of(self._partial.original(where), on_key=on_key)
        return mark.line + 1, mark.column + 1

    def _mark_of(self, where: Where, *, on_key: bool) -> yaml.Mark:
        place = where
        while place not in self._places:
            place = place[:-1]
        key, node = self._places[place]
        return key if key is not None and (on_key or place != where) else node.start_mark

    def _problem_at(self, where: Where, words: str, *, on_key: bool) -> Problem:
        mark = self._mark_of(where, on_key=on_key)
        return Problem(mark.line + 1, mark.column + 1, format_place(where, self.tree), words)

    def _construct(self, where: Where, key: yaml.Mark | None, node: yaml.Node) -> Any:
        """Return plain data with all aliases expanded. Raises BadFile if it has too many values or levels."""
        self._places[where] = (key, node)
        self._value_count += 1
        if self._value_count > MAX_YAML_VALUES or len(where) > MAX_YAML_DEPTH:
            excess = (
                f"nested more than {MAX_YAML_DEPTH} deep"
                if len(where) > MAX_YAML_DEPTH
                else f"more than {MAX_YAML_VALUES} values"
            )
            raise BadFile(self.source, [self._problem_at(where[:3], f"{excess}, aliases written out", on_key=True)])
        if isinstance(node, yaml.ScalarNode):
            return self._construct_scalar(where, node)
        assert isinstance(node, yaml.CollectionNode)
        if node.tag != _COLLECTIONS[type(node)]:
            self.report(where, f"the tag {_quote_tag(node)} is not allowed: leave it out")
            return None
        if isinstance(node, yaml.SequenceNode):
            return [self._construct((*where, index), None, each) for index, each in enumerate(node.value)]
        assert isinstance(node, yaml.MappingNode)
        return dict(self._construct_items(where, node))

    def _construct_items(self, where: Where, node: yaml.MappingNode) -> Iterator[tuple[str, Any]]:
        seen: dict[str, int] = {}
        for key_node, value_node in node.value:
            mark, place, words = key_node.start_mark, where, ""
            name: str = key_node.value
            if not isinstance(key_node, yaml.ScalarNode) or not key_node.tag.endswith(":str"):
                words = f"key {quote_value(name)} is not a word. Write it in quotes, or with a letter first."
            elif name in seen:
                place, words = (*where, name), f"is given twice, first in line {seen[name]}"
            elif not _can_encode(name):
                words = "a key contains half a character (a lone surrogate)"
            if words:
                self._problems.append(Problem(mark.line + 1, mark.column + 1, format_place(place), words))
                continue
            seen[name] = mark.line + 1
            yield name, self._construct((*where, name), mark, value_node)

    def _construct_scalar(self, where: Where, node: yaml.ScalarNode) -> Any:
        text = quote_value(node.value)
        try:
            value = self._loader.construct_object(node)
        except yaml.MarkedYAMLError:
            self.report(where, f"the tag {_quote_tag(node)} is not allowed: leave it out")
        except (ValueError, KeyError, IndexError):  # `!!int zz`, a number of five thousand digits
            self.report(where, f"{text} does not fit its tag, or has too many digits")
        else:
            if isinstance(value, str) and not _can_encode(value):
                self.report(where, f"{text} contains half a character (a lone surrogate)")
            elif isinstance(value, float) and not math.isfinite(value):
                self.report(where, f"{text} is not a finite number")
            elif isinstance(value, int) and abs(value) > _MAX_INTEGER:
                self.report(where, f"{text} is too large a number")
            elif value is None:
                # After `color:`, a color without quotes is a comment. So the value seems to be missing.
                mark = node.end_mark
                if mark.buffer is not None and (color := _COLOR_COMMENT.match(mark.buffer, mark.pointer - 1)):
                    self.report(where, _quote_color(color[1]))
            else:
                return value
        return None


class _Loader(CoreLoader):  # type: ignore[misc]  # the class has no stubs
    """YAML 1.2's core schema, with a limit of depth because PyYAML composes by recursion."""

    def __init__(self, text: str) -> None:
        self._depth = 0
        super().__init__(text)

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose a node with its children."""
        self._depth += 1
        if self._depth > MAX_YAML_DEPTH + 1:
            mark = self.peek_event().start_mark
            raise yaml.composer.ComposerError(None, None, f"nested more than {MAX_YAML_DEPTH} deep", mark)
        node: yaml.Node | None = super().compose_node(parent, index)
        self._depth -= 1
        return node


def _syntax_problem(error: yaml.MarkedYAMLError) -> Problem:
    mark = error.problem_mark or error.context_mark
    line, column = (1, 1) if mark is None else (mark.line + 1, mark.column + 1)
    if mark is not None and mark.buffer is not None:
        # A color without quotes is a comment, which hides the closing bracket. PyYAML reports the error at the next
        # token, often a line below.
        begin = max(0, min(mark.line - 1, error.context_mark.line if error.context_mark else mark.line))
        for at, text in enumerate(mark.buffer.splitlines()[begin : mark.line + 1], begin + 1):
            if color := _COLOR_COMMENT.search(text):
                return Problem(at, color.start(1) + 1, "", _quote_color(color[1]))
    problem = " ".join((error.problem or error.context or "it cannot be read").split())
    if "'\\t'" in problem:
        problem = "a tab. YAML needs spaces"
    elif "'@'" in problem or "'`'" in problem:
        problem = f"a text that begins with {'@' if '@' in problem else '`'}. Write it in quotes"
    elif "single document" in (error.context or ""):
        problem = "a second document (`---`). A file must have only one"
    return Problem(line, column, "", f"this is not YAML: {problem}")


def _quote_color(color: str) -> str:
    return f"a # begins a comment. Write the color in quotes: '{color}'"


def _can_encode(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _quote_tag(node: yaml.Node) -> str:
    return quote_value(str(node.tag).replace("tag:yaml.org,2002:", "!!"))
