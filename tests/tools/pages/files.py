"""The fields of fleet files, plans and worlds, from the JSON Schemas that `fleet schema` prints."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from fleet.fleetfile import fleet_file
from fleet.fleetfile.fleet_model import FileEntry
from fleet.policy.lint import lint
from fleet.policy.plan import plan_parser
from fleet.policy.plan.plan_model import PlanEntry
from schemas.world_check import check_world
from schemas.world_fields import WorldEntry
from schemas.yaml_document.document import schema_of
from tests.tools.pages.command_line import escape

SchemaMaker = Callable[[], dict[str, Any]]


def schema_tables(schema: dict[str, Any]) -> str:
    """Return a table of fields for the file and for each kind of entry in it."""
    definitions = schema.get("$defs", {})
    parts = []
    for name, part in {"": schema, **definitions}.items():
        if "properties" not in part:
            continue
        words = " ".join(str(part.get("description", "")).split())
        rows = ["| field | value | default | what it is |", "|---|---|---|---|"]
        required = set(part.get("required", ()))
        for field, each in part["properties"].items():
            rows.append(
                f"| `{field}` | {_value(each, definitions)} | {_default(each, field in required)} | {about(each)} |"
            )
        heading = f"## {_title(name)}\n\n" if name else ""
        parts.append(f"{heading}{escape(words)}\n\n" + "\n".join(rows))
    return "\n\n".join(parts)


def _title(name: str) -> str:
    return name.removesuffix("Entry")


def _value(each: dict[str, Any], definitions: dict[str, Any]) -> str:
    """Return a short text about the values of a field."""
    if "$ref" in each:
        name = each["$ref"].rpartition("/")[2]
        target = definitions.get(name, {})
        return (
            _value(target, definitions) if "properties" not in target else f"[{_title(name)}](#{_title(name).lower()})"
        )
    if "allOf" in each:
        return _value(each["allOf"][0], definitions)
    if "anyOf" in each or "oneOf" in each:
        kinds = [kind for kind in each.get("anyOf", each.get("oneOf", [])) if kind.get("type") != "null"]
        return " or ".join(dict.fromkeys(_value(kind, definitions) for kind in kinds))
    if "enum" in each:
        return ", ".join(f"`{word}`" for word in each["enum"])
    if "const" in each:
        return f"`{each['const']}`"
    kind = each.get("type", "")
    if kind == "array":
        if points := each.get("prefixItems"):
            return f"lists of {len(points)} numbers{_bounds(points[0])}"
        return f"list of {_value(each.get('items', {}), definitions)}"
    if kind == "object":
        below = next(iter(each.get("patternProperties", {}).values()), each.get("additionalProperties", {}))
        return f"by name: {_value(below, definitions)}"
    return f"{ {'string': 'text', 'boolean': 'true, false', 'integer': 'whole number'}.get(kind, kind) }{_bounds(each)}"


def _bounds(each: dict[str, Any]) -> str:
    low = each.get("minimum", each.get("exclusiveMinimum"))
    high = each.get("maximum", each.get("exclusiveMaximum"))
    if low is None and high is None:
        return ""
    if low is not None and high is not None and "exclusiveMinimum" in each:
        return f", more than {low:g}, at most {high:g}"
    return (
        f", {low:g} to {high:g}"
        if low is not None and high is not None
        else f", from {low if low is not None else high:g}"
    )


def _default(each: dict[str, Any], required: bool) -> str:
    if required:
        return "required"
    default = each.get("default")
    return (
        f"`{str(default).lower() if isinstance(default, bool) else default}`"
        if default not in (None, [], {}, "")
        else ""
    )


def about(each: dict[str, Any]) -> str:
    """Return the description of a field."""
    words = each.get("description") or next(
        (kind["description"] for kind in each.get("anyOf", []) if "description" in kind), ""
    )
    return escape(" ".join(words.split())).replace("|", "\\|")


def fleet_schema() -> dict[str, Any]:
    """Return the schema of fleet files."""
    return schema_of(FileEntry, "fleet file")


def plan_schema() -> dict[str, Any]:
    """Return the schema of plans."""
    return schema_of(PlanEntry, "plan file")


def world_schema() -> dict[str, Any]:
    """Return the schema of world files."""
    return schema_of(WorldEntry, "world file")


def problems(kind: str, text: str) -> list[str]:
    """Return the faults that the reader and the check of this kind of file find in a text."""
    try:
        if kind == "plan":
            return [str(each) for each in lint.check(plan_parser.parse(text, "plan.yaml")) if each.severity == "error"]
        if kind == "fleet":
            fleet_file.parse_fleet(text, Path("fleet.yaml"))
        else:
            check_world(text, "world.yaml")
    except ValueError as error:
        return [str(error)]
    return []
