"""A plan has a name for people."""

import pytest

from fleet.console.plan_view import MAX_PLAN_NAME_LENGTH, named, plan_name
from fleet.console.server import example_plans
from fleet.policy.plan.plan_parser import parse


@pytest.mark.parametrize(
    ("text", "roles", "name"),
    [
        ("# Two cars patrol.\nroles: {}", ["guide"], "Two cars patrol"),
        ("\n# yaml-language-server: $schema=x\n#\n#  The rest\n", [], "The rest"),
        ("roles: {}\n# Below", ["guide", "rest"], "guide, rest"),
        ("", [], "without a name"),
        (f"# {'x' * 200}", [], "x" * MAX_PLAN_NAME_LENGTH),
    ],
)
def test_name_is_the_first_comment_or_the_roles(text: str, roles: list[str], name: str) -> None:
    assert plan_name(text, roles) == name


def test_plan_hash_in_words_becomes_name() -> None:
    text = "# Two cars patrol.\nroles:\n  guide: {mode: manual}\n"
    assert named(f"plan {parse(text).version} is in force", text) == "plan “Two cars patrol” is in force"


def test_each_example_has_a_name_of_its_own() -> None:
    names = [each["name"] for each in example_plans()]
    assert len(set(names)) == len(names) >= 4
    assert "" not in names
