"""`fleet init, schema`: writes and describes fleet files. No car moves.

Other commands use this module to read fleet files and to ask the user.
"""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

import click
from msgspec import to_builtins

from fleet.commands.exit_code import cli_errors
from fleet.commands.params import Choice, Duration, Number
from fleet.fleet_links import LINK_SIM
from fleet.fleetfile.fleet_file import FleetFile, default_color, parse_fleet, read_fleet
from fleet.fleetfile.fleet_model import FileEntry, validate_car_name, validate_color, validate_link, validate_platform
from fleet.fleetfile.scan_process import LIKELY_VERDICTS, FoundLink, ScanFailed, scan
from fleet.fleetfile.template import NewCar, format_new_file, format_new_plan
from fleet.supervisor.spec import MAX_SIMULATED_CARS
from schemas import keys
from schemas.atomic_file import write_atomically
from schemas.words import Platform
from schemas.world_fields import WorldEntry
from schemas.yaml_document.document import BadFile, Entry, schema_of
from schemas.yaml_document.fault_words import list_words

SCHEMAS: Final = ("fleet", "plan", "world")
DEFAULT_FILE: Final = Path("fleet.yaml")
DEFAULT_CAR_NAMES: Final = ("red", "green", "blue", "yellow", "violet", "orange", "teal", "brown")
"""Default names, in the order of the default colors."""
_SKIP: Final = "-"
_OTHER_FILE: Final = "name another file with --out"
_TAKE_ALL: Final = "`fleet init --yes` takes every likely car without a question"

file_argument = click.argument(
    "file", default=DEFAULT_FILE, type=click.Path(path_type=Path, dir_okay=False), metavar="[FILE]"
)
link_option = click.option("--link", "links", multiple=True, metavar="URL", help="Scan only this link. Repeatable.")
listen_option = click.option(
    "--for", "seconds", type=Duration(120.0, 0.5), help="How long to listen at each port (default: 6s)."
)


def read(file: Path, *, as_json: bool = False, unbound: bool = False) -> FleetFile:
    """Read the fleet file. If it is invalid, print every error on its own line and exit with code 2."""
    try:
        return read_fleet(file, unbound=unbound)
    except BadFile as error:
        print_errors(error, as_json=as_json)
        if not file.exists():
            click.echo("`fleet init` creates one.", err=True)
        raise SystemExit(2) from None


def print_errors(error: BadFile, *, as_json: bool = False) -> None:
    """Print every error of a file on its own line: for a person to stderr, as JSON to stdout."""
    if as_json:
        for problem in error.problems:
            click.echo(json.dumps({"file": error.source, "severity": "error", **to_builtins(problem)}))
    else:
        click.echo(str(error), err=True)


@click.command(
    "schema",
    epilog="\b\nexamples:\n  fleet schema fleet > fleet.schema.json\n  fleet schema plan\n  fleet schema world",
)
@click.argument("kind", type=Choice("kind of file", SCHEMAS), default="fleet", metavar="fleet|plan|world")
def print_schema(kind: str) -> None:
    """Print the JSON Schema of fleet files, plans or worlds. Editors complete and check files with it."""
    click.echo(schema_text(kind), nl=False)


def schema_text(kind: str) -> str:
    """Return the JSON Schema of a kind of file: the text of `deploy/KIND.schema.json`."""
    from fleet.policy.plan.plan_model import PlanEntry

    models: dict[str, type[Entry]] = {"fleet": FileEntry, "plan": PlanEntry, "world": WorldEntry}
    return json.dumps(schema_of(models[kind], f"{kind} file"), indent=2, ensure_ascii=False) + "\n"


@click.command(
    epilog="""\b
examples:
  fleet init
  fleet init --sim 3         # simulated cars, and a first plan for them
  fleet init --yes --out lab.yaml
  fleet init --link /dev/ttyUSB0 --link tcp://192.168.1.7:8888"""
)
@click.option(
    "--sim",
    "simulated",
    type=Number(int, 1, MAX_SIMULATED_CARS),
    metavar="N",
    help="Write N simulated cars and plan.yaml. Do not look for cars.",
)
@click.option("-y", "--yes", is_flag=True, help="Accept every likely car without asking.")
@click.option("--force", is_flag=True, help="Overwrite an existing file.")
@click.option(
    "-o",
    "--out",
    default=DEFAULT_FILE,
    show_default=True,
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Write this file.",
)
@link_option
@listen_option
def init(
    *, simulated: int | None, yes: bool, force: bool, out: Path, links: tuple[str, ...], seconds: float | None
) -> None:
    """Write a fleet file: look for cars and ask for their names, or simulate cars."""
    if simulated and links:
        raise click.UsageError("--sim and --link exclude each other: give one of them")
    with cli_errors():
        for link in links:
            validate_link(link)
    plan = out.with_name("plan.yaml")
    for path in (out, plan) if simulated else (out,):
        if path.exists() and not force:
            if yes or simulated:
                other = "--out for another" if path == out else f"--out in a directory without {path.name}"
                raise click.UsageError(f"{path} exists already: give --force to overwrite it, or {other}")
            if not confirm(f"{path} exists already. Overwrite it?", f"give --force, or {_OTHER_FILE}"):
                click.echo(f"Nothing was written. To keep {path}, {_OTHER_FILE}.", err=True)
                raise click.Abort
    if not out.absolute().parent.is_dir():
        raise click.UsageError(f"{out}: there is no such directory")
    if simulated:
        cars = [_new_car(index, LINK_SIM, Platform.ARDUINO) for index in range(simulated)]
        write(plan, format_new_plan(simulated))
    else:
        found = look_for(links, seconds)
        cars = _likely_cars(found) if yes else _prompt_cars(found)
    if not cars:
        raise click.ClickException(
            "No car found. Is the car on and in range? `fleet scan` shows every link.\n"
            "Wi-Fi cars: add --link tcp://HOST:8888. No car at hand? `fleet init --sim 3`"
        )
    text = format_new_file(cars)
    try:
        parse_fleet(text, out)
    except BadFile as error:
        print_errors(error)
        raise click.ClickException("nothing was written: two of the links may be the same port") from None
    write(out, text)
    names = list_words([car.name for car in cars])
    click.echo(f"Wrote {out}{f' and {plan}' if simulated else ''} with {names}. Next, type:")
    where = "" if out == DEFAULT_FILE else f" {out}"
    click.echo(f"  fleet check{where}\n  fleet up{where}")
    if simulated:
        click.echo(f"or, with the plan:\n  fleet up{where} --plan {plan}")


def look_for(links: tuple[str, ...], seconds: float | None) -> list[FoundLink]:
    """Scan for cars, and return the likely ones first. Raises click.ClickException if the scan fails."""
    try:
        found = scan(links, seconds)
    except ScanFailed as error:
        raise click.ClickException(str(error)) from None
    return sorted(found, key=lambda each: each.verdict not in LIKELY_VERDICTS)


def write(path: Path, text: str) -> None:
    """Write or replace a file atomically. The line ends of the text stay as they are."""
    path = path.resolve()
    try:
        write_atomically(path, text.encode())
    except OSError as error:
        raise click.ClickException(f"{path} cannot be written: {error.strerror}") from None


def _new_car(index: int, link: str, platform: str, words: str = "") -> NewCar:
    name = DEFAULT_CAR_NAMES[index] if index < len(DEFAULT_CAR_NAMES) else f"car{index + 1}"
    return NewCar(name, link, platform, default_color(name, index), words)


def _likely_cars(found: list[FoundLink]) -> list[NewCar]:
    likely = [each for each in found if each.verdict in LIKELY_VERDICTS]
    return [_new_car(index, each.url, each.platform, each.words) for index, each in enumerate(likely)]


def _prompt_cars(found: list[FoundLink]) -> list[NewCar]:
    cars: list[NewCar] = []
    for each in found:
        click.echo(f"\n{each.url}\n  {each.words}")
        free = [name for name in DEFAULT_CAR_NAMES if name not in {car.name for car in cars}] or [f"car{len(cars) + 1}"]
        offered = free[0] if each.verdict in LIKELY_VERDICTS else _SKIP
        taken = {car.name for car in cars}
        name = prompt_name(f"  its name ({_SKIP} to leave it out)", offered, taken, _TAKE_ALL)
        if name == _SKIP:
            continue
        platform = prompt(
            "  its platform", default=each.platform, value_proc=_prompt_check(validate_platform), instead=_TAKE_ALL
        )
        color = prompt(
            "  its color",
            default=default_color(name, len(cars)),
            value_proc=_prompt_check(validate_color),
            instead=_TAKE_ALL,
        )
        cars.append(NewCar(name, each.url, platform, color, each.words))
    return cars


def prompt_name(words: str, offered: str | None, taken: set[str], instead: str = "") -> str:
    """Prompt for an unused name of a car, or `-`. `instead` is the command to propose if nobody can answer."""

    def check_name(name: str) -> str:
        name = name.strip()
        if name in taken:
            raise click.UsageError(f"{name} is already the name of another car")
        proposed = re.sub("[^a-z0-9_]+", "-", name.lower()).strip("-_")
        if name != proposed and name != _SKIP and keys.is_name(proposed):
            raise click.UsageError(f'"{name}" is not a car name: use {keys.NAME_RULE}, such as {proposed}.')
        return name if name == _SKIP else _prompt_check(validate_car_name)(name)

    name: str = prompt(words, default=offered, value_proc=check_name, instead=instead)
    return name


def prompt(words: str, *, default: str | None, value_proc: Callable[[str], str], instead: str = "") -> str:
    """Prompt until the answer is valid. If the input ends, raise click's error, which proposes `instead`."""
    while True:
        try:
            return value_proc(click.prompt(words, default=default, type=str))
        except click.UsageError as error:
            click.echo(f"fleet: {error.message}")
        except click.Abort as error:
            raise _error_without_answer(error, instead) from None


def confirm(words: str, instead: str = "") -> bool:
    """Ask for yes or no. If the input ends, raise click's error, which proposes `instead`."""
    try:
        return click.confirm(words)
    except click.Abort as error:
        raise _error_without_answer(error, instead) from None


def _error_without_answer(error: click.Abort, instead: str) -> click.Abort | click.ClickException:
    """Return the error for a question without an answer. An Abort after Ctrl-C is returned unchanged."""
    if isinstance(error.__context__, KeyboardInterrupt):
        return error
    click.echo()
    why = "the input has ended" if sys.stdin.isatty() else "stdin is not a terminal, and no answer came from it"
    other = f", or {instead}" if instead else ""
    return click.ClickException(f"Nothing is written without an answer: {why}. Type the command at a terminal{other}.")


def _prompt_check(rule: Callable[[str], str]) -> Callable[[str], str]:
    """Return a function that applies the rule to an answer. If the answer breaks the rule, `prompt` asks again."""

    def check(text: str) -> str:
        try:
            return rule(text.strip())
        except ValueError as error:
            raise click.UsageError(str(error)) from None

    return check
