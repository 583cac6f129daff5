"""The page docs/reference/python.md: the public names with their docstrings.

It has the docstrings of the code, so a wrong docstring is corrected in one place.
"""

import inspect
import re
from collections.abc import Callable
from enum import StrEnum

from fleet import Catalog, LeaseLost, NotCarriedOut, Outcome, Reading, Session, aio, conditions
from fleet.client import client, reading, wait
from fleet.client.commands import CarCommands
from fleet.client.lease import Lease
from fleet.recording.catalog import BadQuery, QueryFailed
from fleet.recording.reading.session import NoSession
from fleet.recording.tools.analysis import NoTable
from fleet.recording.tools.table_formats import FormatMissing
from schemas import bus, keys

_HEAD = """# Python

This page has every public name of the Python client. Times are in seconds, distances in meters and angles in degrees,
unless a name says otherwise. A value that was not measured is None.

```python
from fleet import Fleet, LeaseLost, NotCarriedOut, Session
```

`from fleet.aio import Fleet` has the same names for asyncio; there you await the calls that the last section lists.
The guide "Drive from Python" has examples. The glossary explains words such as lease and hold.
"""
_CLASSES: tuple[tuple[str, type], ...] = (
    ("Fleet", client.Fleet),
    ("Car", client.Car),
    ("Lease", Lease),
    ("Outcome", Outcome),
    ("Reading", Reading),
    ("Watch", reading.Watch),
    ("Session", Session),
    ("Catalog", Catalog),
)
_ERRORS = (
    NotCarriedOut,
    LeaseLost,
    wait.NotInTime,
    conditions.BadExpression,
    keys.BadKey,
    bus.BadEndpoint,
    bus.NoFleet,
    bus.BusError,
    NoSession,
    NoTable,
    BadQuery,
    QueryFailed,
    FormatMissing,
)
_HIDDEN = {"do", "ask", "call", "begin", "expression", "check_open"}
"""Methods for the package's own use."""
_INTERNAL = {
    *((Lease, name) for name in ("check", "checked")),
    *(
        (Session, name)
        for name in ("part", "lacking", "check", "rescue", "rows", "expected", "extras", "indexes", "selection")
    ),
}


def reference() -> str:
    """Return the text of the page."""
    parts = [_HEAD]
    for name, each in _CLASSES:
        parts.append(f"## {name}\n\n{_text(each)}\n")
        if each in (client.Fleet, Session, Catalog):
            parts.append(f"### `{name}{_signature(inspect.getattr_static(each, '__init__'))}`\n")
        parts.append("\n".join(_attributes(each)))
        parts += [_method(each, method) for method in _methods(each)]
    parts.append("## Errors\n\n" + "\n".join(f"- `{_module(each)}{each.__name__}`: {_text(each)}" for each in _ERRORS))
    parts.append("\n## fleet.aio\n\n" + _text(aio) + "\n")
    parts += [_async(name) for name in ("Fleet", "Car", "Lease", "Watch")]
    return re.sub(r"\n{3,}", "\n\n", "\n".join(parts)).rstrip() + "\n"


def _text(of: object) -> str:
    """Return a docstring without its indentation."""
    words = inspect.getdoc(of)
    assert words, f"{of} has no docstring"
    return words


def _methods(of: type) -> list[str]:
    """Return public methods and properties in the order of the source, those of `CarCommands` last."""
    found: dict[str, None] = {}
    for base in (each for each in of.__mro__ if each in (of, CarCommands)):
        for name, member in vars(base).items():
            callable_or_property = inspect.isfunction(member) or isinstance(member, property)
            public = name == "__getitem__" or not name.startswith("_")
            if callable_or_property and public and name not in _HIDDEN and (of, name) not in _INTERNAL:
                found[name] = None
    return list(found)


def _method(of: type, name: str) -> str:
    member = inspect.getattr_static(of, name)
    if isinstance(member, property):
        return f"### `{name}`\n\n{_text(member)}\n"
    shown = "reading[field]" if name == "__getitem__" else f"{name}{_signature(getattr(of, name))}"
    return f"### `{shown}`\n\n{_text(member)}\n"


def _signature(function: Callable[..., object]) -> str:
    """Return the parameters with their types, as a user writes them."""
    signature = inspect.signature(function)
    given = [each for each in signature.parameters.values() if each.name != "self"]
    words = [_parameter(each) for each in given]
    keyword_only = [each.kind is inspect.Parameter.KEYWORD_ONLY for each in given]
    if any(keyword_only) and not any(each.kind is inspect.Parameter.VAR_POSITIONAL for each in given):
        words.insert(keyword_only.index(True), "*")
    gives = "" if function.__name__ == "__init__" else f" -> {_type(signature.return_annotation)}"
    return f"({', '.join(words)}){gives}"


def _parameter(each: inspect.Parameter) -> str:
    given = str(each.default) if isinstance(each.default, StrEnum) else each.default
    default = "" if given is inspect.Parameter.empty else f" = {given!r}"
    star = "*" if each.kind is inspect.Parameter.VAR_POSITIONAL else ""
    return f"{star}{each.name}: {_type(each.annotation)}{default}"


def _type(annotation: object) -> str:
    """Return a type without the modules of its names."""
    words = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    return "Outcome" if words == "~R" else re.sub(r"\b(?:\w+\.)+(?=\w)", "", words).strip("'")


def _attributes(of: type) -> list[str]:
    """Return the fields of a class with their docstrings."""
    source = inspect.getsource(of)
    if not (hasattr(of, "__dataclass_fields__") or hasattr(of, "__struct_fields__")):
        return []
    found = re.findall(r'^    (\w+): ([^=\n]+?)(?: = [^\n]+)?\n(?:    """((?:.|\n)*?)""")?', source, flags=re.MULTILINE)
    return [
        f"- `{name}: {kind}`" + (f": {' '.join(words.split())}" if words else "") for name, kind, words in found
    ] + [""]


def _module(error: type) -> str:
    return "" if error in (NotCarriedOut, LeaseLost) else f"{error.__module__}."


def _async(name: str) -> str:
    """Return the differences of a class to its blocking twin. All else has the same names and parameters."""
    each = getattr(aio, name)
    awaited = [
        f"`{method}`"
        for method, member in vars(each).items()
        if inspect.iscoroutinefunction(member) and not method.startswith("_") and method not in _HIDDEN
    ]
    verbs = ["every command"] if issubclass(each, CarCommands) else []
    extra = f" Awaited: {', '.join(awaited + verbs)}." if awaited or verbs else ""
    return f"- `{name}`: {' '.join(_text(each).split())}{extra}"
