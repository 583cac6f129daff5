"""`fleet check`: checks fleet files, plans and worlds. It recognizes the kind of a file by its content."""

import json
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from enum import IntEnum, StrEnum
from pathlib import Path
from typing import Any, Final

import click
import yaml
from msgspec import to_builtins

from fleet.commands.exit_code import cli_errors
from fleet.commands.fleet_file import DEFAULT_FILE, print_errors
from fleet.commands.options import json_option
from fleet.coordinator.observer import listed_cars
from fleet.fleet_links import LINK_SIM, parse_fleet_link
from fleet.fleetfile.adapter_check import check_adapters, list_adapters
from fleet.fleetfile.fleet_file import FleetFile, read_fleet
from fleet.fleetfile.fleet_model import FileEntry
from fleet.fleetfile.link_check import check_link
from fleet.policy.lint.lint import Severity
from fleet.policy.lint.lint import check as find_findings
from fleet.policy.plan.plan_model import PlanEntry
from fleet.policy.plan.plan_parser import parse as parse_plan
from fleet.policy.snapshot import CarSnapshot
from schemas import bus
from schemas.words import Rank
from schemas.world_check import check_world
from schemas.world_fields import WorldEntry
from schemas.yaml_document.document import BadFile, read_text

_CHECK_THREADS: Final = 16
_Cars = Mapping[str, CarSnapshot] | None


class FileKind(StrEnum):
    """The kind of a file."""

    FLEET = "fleet file"
    PLAN = "plan"
    WORLD = "world"


class _Result(IntEnum):
    """The result for one file, which is also an exit code."""

    GOOD = 0
    FAILED = 1
    """A car cannot be reached, or a part of a plan can never work."""
    WRONG = 2


@click.command(
    epilog="""\b
examples:
  fleet check
  fleet check plan.yaml
  fleet check fleet.yaml plan.yaml world.yaml --json

Exit codes: 0 no mistakes, 1 a car cannot be reached or a part of a plan can never work, 2 a file is wrong."""
)
@click.argument("files", nargs=-1, metavar="[FILE...]", type=click.Path(path_type=Path, dir_okay=False))
@json_option
def check(files: tuple[Path, ...], *, as_json: bool) -> None:
    """Check fleet files, plans and worlds (default: fleet.yaml), and whether each car's port exists and is free.

    For a car on TCP, it checks whether the host is there. The command does not touch the cars. If a fleet file names a
    plan or a world, the command checks it for the cars of that fleet. It warns if a Bluetooth adapter has more cars
    than the adapter can connect at once.
    """
    checks = _Checks(as_json=as_json)
    kinds = {file: checks.recognize(file) for file in files or (DEFAULT_FILE,)}
    for kind in FileKind:  # fleet files first, because plans are checked for the cars in them
        for file, recognized in kinds.items():
            if recognized is kind:
                checks.check(kind, file)
    raise SystemExit(int(checks.result))


class _Checks:
    """The checks of one call of `fleet check`."""

    def __init__(self, *, as_json: bool) -> None:
        self.result = _Result.GOOD
        self._as_json = as_json
        self._cars: _Cars = None
        self._simulated: list[str] = []
        """The cars that `carried_by` in a world may name. If the list is empty, it may name any car."""
        self._done: set[Path] = set()

    def recognize(self, file: Path) -> FileKind | None:
        """Return the kind of a file. If it cannot be read, add an error and return None."""
        try:
            text = read_text(file)
        except BadFile as error:
            self._wrong(error)
            if file == DEFAULT_FILE and not file.exists():
                click.echo("fleet: make one with `fleet init`", err=True)
            return None
        return recognize(text)

    def check(self, kind: FileKind, file: Path) -> None:
        """Check one file, and the files that it names."""
        if file.resolve() in self._done:
            return
        self._done.add(file.resolve())
        try:
            match kind:
                case FileKind.FLEET:
                    self._check_fleet(file)
                case FileKind.PLAN:
                    self._check_plan(file)
                case FileKind.WORLD:
                    self._check_world(file)
        except BadFile as error:
            self._wrong(error)

    def _check_fleet(self, file: Path) -> None:
        fleet = read_fleet(file)
        if self._cars is None:
            self._cars = listed_cars(fleet)
            # If no car has the link `sim`, take all: `fleet up --sim N` simulates cars that have a port, too.
            self._simulated = [name for name, car in fleet.cars.items() if car.link == LINK_SIM] or list(fleet.cars)
        running_links = _running_links(fleet)
        with ThreadPoolExecutor(_CHECK_THREADS) as pool:
            found = list(pool.map(lambda car: check_link(car, running_links), fleet.cars.values()))
        widest = max(len(each.car) for each in found)
        for each in found:
            state = "ok" if each.ok else "error"
            self._print(to_builtins(each), f"{each.car:{widest}}  {state:5}  {each.link}: {each.words}")
            self._worse(_Result.GOOD if each.ok else _Result.FAILED)
        links = {name: parse_fleet_link(car.link) for name, car in fleet.cars.items()}
        for load in check_adapters(links, list_adapters()):
            if load.is_crowded:
                self._print(to_builtins(load), f"{load.adapter:{widest}}  warn   {load.words}")
        for kind, path in ((FileKind.PLAN, fleet.plan), (FileKind.WORLD, fleet.world)):
            if path is not None:
                self.check(kind, path)

    def _check_plan(self, file: Path) -> None:
        plan = parse_plan(read_text(file), str(file))
        findings = find_findings(plan, self._cars)
        for each in findings:
            self._print({"file": str(file), **to_builtins(each)}, each.at(str(file)))
        if any(each.severity is Severity.ERROR for each in findings):
            self._worse(_Result.FAILED)
            return
        parts = {"role": len(plan.roles), "rule": len(plan.rules), "phase": len(plan.phases)}
        self._good(file, FileKind.PLAN, ", ".join(f"{n} {part}{'' if n == 1 else 's'}" for part, n in parts.items()))

    def _check_world(self, file: Path) -> None:
        try:
            check_world(read_text(file), str(file), self._simulated or None)
        except BadFile as error:
            self._print_world_faults(file, error)
            self._worse(_Result.WRONG)
        else:
            self._good(file, FileKind.WORLD, "can be simulated")

    def _print_world_faults(self, file: Path, error: BadFile) -> None:
        if not self._as_json:
            click.echo(str(error), err=True)
            return
        for each in error.problems:
            words = f"{each.field}: {each.words}" if each.field else each.words
            place = {"line": each.line, "column": each.column} if each.line else {}
            click.echo(json.dumps({"file": str(file), "severity": "error", "words": words, **place}))

    def _wrong(self, error: BadFile) -> None:
        print_errors(error, as_json=self._as_json)
        self._worse(_Result.WRONG)

    def _good(self, file: Path, kind: FileKind, words: str) -> None:
        if not self._as_json:
            click.echo(f"{file}: {kind}, {words}: no mistakes found")

    def _worse(self, result: _Result) -> None:
        self.result = max(self.result, result)

    def _print(self, values: Mapping[str, object], line: str) -> None:
        click.echo(json.dumps(values) if self._as_json else line)


def recognize(text: str) -> FileKind:
    """Return the kind of a file by its fields.

    If it has no known field, it counts as a fleet file.
    """
    try:
        found: Any = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError):  # a bad date, or nested too deep: the parser will say where
        found = None
    if not isinstance(found, dict):
        return FileKind.PLAN if text.lstrip().startswith(("roles:", "rules:")) else FileKind.FLEET
    names = {str(each) for each in found}
    fields = {
        FileKind.FLEET: frozenset(FileEntry.model_fields),
        FileKind.PLAN: frozenset(each.alias or name for name, each in PlanEntry.model_fields.items()),
        FileKind.WORLD: frozenset(WorldEntry.model_fields),
    }
    if _is_world(found.get("cars")):
        return FileKind.WORLD
    return max(FileKind, key=lambda kind: len(names & fields[kind]))


def _is_world(cars: Any) -> bool:
    """Return True if the `cars` of a file have places."""
    return isinstance(cars, dict) and any(isinstance(each, dict) and "x_m" in each for each in cars.values())


def _running_links(fleet: FleetFile) -> dict[str, tuple[str, str, str]]:
    """Return, for the car of each running gateway, the state, reason and URL of its link. Empty if no fleet runs."""
    from fleet.client.client import Fleet

    with cli_errors():
        if not bus.accepts(bus.resolve_endpoint(fleet.endpoint)):
            return {}
        with Fleet(fleet.endpoint, fleet.name, kind=Rank.PERSON) as client:
            urls = {each.value.car: each.value.link for each in client.get("*/state/health")}
            links = [each.value for each in client.get("*/state/link")]
            return {link.car: (link.state, link.reason, urls.get(link.car, "")) for link in links}
