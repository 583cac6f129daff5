"""Puts pydantic's errors into words for a person. Pure.

An error of pydantic is about one member of a union only, so the allowed values come from the model's JSON schema, which
has all of them. document.py adds the place.
"""

from collections.abc import Collection, Iterable, Mapping
from typing import Any, Final

from schemas.suggestion import did_you_mean

_BOUNDS: Final = {
    "exclusiveMinimum": "more than",
    "minimum": "at least",
    "exclusiveMaximum": "less than",
    "maximum": "at most",
}
Where = tuple[str | int, ...]
"""The path to a value: names of fields, positions in lists."""

_MAX_VALUE_LENGTH: Final = 60
_MAX_WORDS_LISTED: Final = 12
_ITEMS: Final = {"boxes": "box", "capabilities": "capability", "line": "point", "path": "point", "then": "effect"}
"""The name of an item, by the name of its list. An item of any other list has the name of the list without its s."""
_TYPES: Final = {
    "string": "text",
    "integer": "a whole number",
    "number": "a number",
    "boolean": "true or false",
    "array": "a list",
    "object": "fields, `name: value`",
    "null": "nothing",
}


def format_place(where: Where, tree: object = None) -> str:
    """Format a place: `cars.red.limits`, `rule 2, when`. If an item of a list has a name in `tree`, use the name."""
    segments, words = list[str](), list[str]()
    for part in where:
        try:
            tree = tree[part]  # type: ignore[index]  # None, or a scalar, has no parts
        except (TypeError, KeyError, IndexError):
            tree = None
        if isinstance(part, int):
            plural = words.pop() if words else "numbers"
            name = tree.get("name") if isinstance(tree, dict) else None
            if words:
                segments.append(".".join(words))
            item = name if isinstance(name, str) and name.isprintable() and name else part + 1
            segments.append(f"{_ITEMS.get(plural, plural.removesuffix('s'))} {item}")
            words = []
        else:
            words.append(part if part.isprintable() and part and not set(part) & set(" .[]:,") else quote_value(part))
    return ", ".join([*segments, ".".join(words)] if words else segments)


def suggest(word: str, allowed: Iterable[str]) -> str:
    """Return `Did you mean red?`, or the allowed words if none of them is close."""
    words = list(allowed)
    if near := did_you_mean(word, words):
        return near
    verb = "are" if len(words) > 1 else "is only" if words else "is"
    return f"There {verb} {list_words(words)}."


def list_words(words: Collection[str]) -> str:
    """List words, the first ones if there are many."""
    more = f" and {len(words) - _MAX_WORDS_LISTED} more" if len(words) > _MAX_WORDS_LISTED else ""
    return ", ".join([*words][:_MAX_WORDS_LISTED]) + more if words else "none"


def quote_value(value: object) -> str:
    """Format a value for a person, truncated if it is long."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict | list | tuple):
        return "a list" if isinstance(value, list | tuple) else "a mapping"
    text = repr(value)
    return text if len(text) <= _MAX_VALUE_LENGTH else f"{text[:_MAX_VALUE_LENGTH]}…"


def describe_error(kind: str, error: Mapping[str, Any], where: Where, schema: Mapping[str, Any]) -> tuple[str, str]:
    """Return two texts about one of pydantic's errors: what is wrong, and how to mend it. The second may be empty.

    `kind` is pydantic's type of the error, such as `missing`. `where` is the place of the value, and `schema` the JSON
    schema of the model.
    """
    definitions = schema.get("$defs", {})
    if kind == "extra_forbidden":
        allowed = sorted(
            {name for each in _schemas_at(schema, where[:-1], definitions) for name in each.get("properties", ())}
        )
        return "there is no such field", suggest(str(where[-1]), allowed)
    here = _schemas_at(schema, where, definitions)
    if kind == "missing":
        return "is missing", next((_sentence(each["description"]) for each in here if "description" in each), "")
    value = error["input"]
    if kind in ("too_short", "too_long"):
        limits = error["ctx"]
        bound = f"at most {limits['max_length']}" if kind == "too_long" else f"at least {limits['min_length']}"
        return f"has {len(value)} items", f"Write {bound}."
    if kind in ("value_error", "assertion_error"):
        return str(error["ctx"]["error"]), ""
    fault = "has no value" if value is None else f"{quote_value(value)} is not allowed"
    # If only some members of a union are words, the general case below describes all members.
    has_words = ["enum" in each or "const" in each for each in here]
    if kind in ("enum", "literal_error") and (all(has_words) or not any(has_words)):
        words = [str(word) for each in here for word in each.get("enum", [each["const"]] if "const" in each else [])]
        return (fault, suggest(str(value), words)) if words else (fault, f"Write {error['ctx']['expected']}.")
    if where and here and all(each.get("type") == "object" and "properties" in each for each in here):
        name = "- " if isinstance(where[-1], int) else f"{where[-1]}: "
        return fault if value is None else "needs fields", f"Write: `{name}{_example(here[0], value, definitions)}`"
    allowed_here = [words for words in map(_describe_allowed, here) if words and words != "nothing"]
    kinds = ("_type", "_than", "_equal", "_parsing", "int_from_float", "enum", "literal_error")
    if allowed_here and kind.endswith(kinds):
        words = [str(word) for each in here for word in each.get("enum", ())]
        if isinstance(value, str) and (near := did_you_mean(value, words)):
            return fault, near
        if kind.endswith("_type") and isinstance(value, bool | int | float):
            # A number is not text unless it has quotes. Each member of a union has an error about this value, and all
            # get the same words, so that document.py prints them only once.
            allowed_here = ["text in quotes" if each == "text" else each for each in allowed_here]
        return fault, f"Write {' or '.join(dict.fromkeys(allowed_here))}."
    message = str(error["msg"])
    return fault, _sentence(message)


def _sentence(words: str) -> str:
    return f"{words[:1].upper()}{words[1:]}."


def _example(schema: Mapping[str, Any], value: object, definitions: Mapping[str, Any]) -> str:
    """Return an example of a mapping with the fields that it needs. `value` is what the file has there."""
    properties = schema["properties"]
    shown = [name for name, each in properties.items() if "examples" in each]
    names = schema.get("required") or shown or [*properties][:1]
    parts = []
    for name in names:
        words = [word for each in _resolve_members(properties[name], definitions) for word in each.get("enum", ())]
        likely = value in words or (name in shown and isinstance(value, str))
        parts.append(f"{name}: {value if likely else words[0] if words else '…'}")
    return f"{{{', '.join(parts)}}}"


def _describe_allowed(schema: Mapping[str, Any]) -> str:
    """Describe the values that one member of the schema allows, with their range."""
    if "const" in schema:
        return f"the word {schema['const']}"
    if "enum" in schema:
        return f"one of {', '.join(map(str, schema['enum']))}"
    words = _TYPES.get(schema.get("type", ""), "")
    bounds = [f"{text} {schema[key]:g}" for key, text in _BOUNDS.items() if key in schema]
    return f"{words}, {' and '.join(bounds)}" if bounds else words


def _schemas_at(schema: Mapping[str, Any], where: Where, definitions: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the members of the schema for a place, with references and unions resolved."""
    here = _resolve_members(schema, definitions)
    for part in where:
        below: list[Mapping[str, Any]] = []
        for each in here:
            if isinstance(part, int):
                members = [*each.get("prefixItems", [])[part : part + 1], each.get("items")]
            else:
                named = each.get("properties", {})
                others = [each.get("additionalProperties"), *each.get("patternProperties", {}).values()]
                members = [named[part]] if part in named else others
            below += [
                member for one in members if isinstance(one, dict) for member in _resolve_members(one, definitions)
            ]
        here = below
    return here


def _resolve_members(schema: Mapping[str, Any], definitions: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    members: list[Mapping[str, Any]] = []
    if "$ref" in schema:
        members += _resolve_members(definitions[schema["$ref"].rpartition("/")[2]], definitions)
    for key in ("anyOf", "oneOf", "allOf"):
        members += [member for each in schema.get(key, ()) for member in _resolve_members(each, definitions)]
    # A description beside a reference or a union belongs to the field, so it replaces that of the members.
    return [schema] if not members else [{**each, **_own_description(schema)} for each in members]


def _own_description(schema: Mapping[str, Any]) -> dict[str, Any]:
    return {"description": schema["description"]} if "description" in schema else {}
