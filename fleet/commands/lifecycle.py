"""`fleet status, down, reload, logs`: what is asked of a fleet that is up, from another terminal."""

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, Final

import click

from fleet.client.client import default_sender
from fleet.commands.options import bus_options, json_option
from fleet.supervisor.child import entry, runs
from fleet.supervisor.service import STATUS, ask_service, ask_status
from fleet.supervisor.shutdown import NOT_STOPPED
from schemas import keys, messages
from schemas.bus import Bus, BusError, resolve_endpoint
from schemas.process import signals, startup

DOWN_S: Final = 120.0
"""The longest stop of a car, and a recorder that writes what it has."""
GONE_S: Final = 3.0
LOOK_S: Final = 0.2


def _none(fleet: str, endpoint: str) -> click.ClickException:
    return click.ClickException(
        f"fleet {fleet} is not up at {endpoint}: fleet up starts it, --connect names another bus"
    )


@click.command(epilog="\b\nexample:\n  fleet status --json")
@json_option
@bus_options
def status(connect: str | None, fleet: str, *, as_json: bool) -> None:
    """What `fleet up` runs: each process, since when, how often it was started again, and why."""
    keys.check_name(fleet, "fleet name")
    with Bus.open(connect) as bus:
        found = ask_status(bus, fleet)
        if not found:
            raise _none(fleet, bus.endpoint)
    for each in found:
        if as_json:
            click.echo(messages.to_json(each))
            continue
        what = each.fleet_file or "simulated cars"
        click.echo(f"fleet {fleet} is {each.state}: {what}, process {each.pid} on {each.host}, {each.uptime_s:.0f} s")
        click.echo(f"logs: {each.directory}")
        for process in each.processes:
            pid = f"process {process.pid}" if process.HasField("pid") else "no process"
            times = "once" if process.restarts == 1 else f"{process.restarts} times"
            again = f", started again {times}: {process.words}" if process.restarts else ""
            why = f": {process.words}" if process.words and not process.restarts else ""
            click.echo(f"  {process.name:14} {process.state:9} {process.since_s:6.0f} s  {pid}{again}{why}")


@click.command(epilog="\b\nexample:\n  fleet down")
@json_option
@bus_options
def down(connect: str | None, fleet: str, *, as_json: bool) -> None:
    """End a fleet that is up, as Ctrl-C there does, wait, and say what became of each car."""
    keys.check_name(fleet, "fleet name")
    with Bus.open(connect) as bus:
        heard: list[Any] = []
        bus.subscribe(f"{fleet}/{STATUS.name}", lambda sample: heard.append(sample.message()))
        if not ask_status(bus, fleet) or (answer := ask_service(bus, fleet, "down", default_sender())) is None:
            raise _none(fleet, bus.endpoint)
        if answer.status == "rejected":
            raise click.ClickException(answer.words)
        last = _until_ended(bus, fleet, heard)
    became = dict(last.became) if last is not None else {}
    ended = last is not None and last.state == "ended"
    bad = sorted(car for car, words in became.items() if words.startswith(NOT_STOPPED))
    if as_json:
        click.echo(json.dumps({"ended": ended, "cars": became}))
    else:
        for car, words in sorted(became.items()):
            click.echo(f"{car}: {words}", err=car in bad)
    if not ended:
        raise click.ClickException("the supervisor is gone without a last word: see fleet logs, and fleet list")
    raise SystemExit(1 if bad else 0)


def _until_ended(bus: Bus, fleet: str, heard: list[Any]) -> Any:
    """The last status that is heard."""
    deadline, at = time.monotonic() + DOWN_S, time.monotonic()
    count = 0
    while time.monotonic() < deadline:
        if len(heard) != count:
            count, at = len(heard), time.monotonic()
            if heard[-1].state == "ended":
                break
        elif time.monotonic() - at > GONE_S and not bus.tokens(keys.car_token(fleet, keys.SUPERVISOR)):
            break
        time.sleep(LOOK_S)
    return heard[-1] if heard else None


@click.command(epilog="\b\nexample:\n  fleet reload")
@json_option
@bus_options
def reload(connect: str | None, fleet: str, *, as_json: bool) -> None:
    """Have the fleet file read again: cars that are new, gone or changed, and the plan; says what needs a new start."""
    keys.check_name(fleet, "fleet name")
    with Bus.open(connect) as bus:
        answer = ask_service(bus, fleet, "reload", default_sender())
        if answer is None:
            raise _none(fleet, bus.endpoint)
    if as_json:
        click.echo(messages.to_json(answer))
    else:
        click.echo(answer.words, err=answer.status == "rejected")
    raise SystemExit(2 if answer.status == "rejected" else 0)


@click.command(epilog="\b\nexamples:\n  fleet logs red\n  fleet logs hub --follow\n  fleet logs red --json")
@click.argument("name", metavar="CAR")
@click.option("--follow", is_flag=True, help="Go on until Ctrl-C.")
@json_option
@bus_options
def logs(name: str, connect: str | None, fleet: str, *, follow: bool, as_json: bool) -> None:
    """What a car's gateway has said, or hub, simulator, coordinator, recorder; of the run that is up, else the last."""
    directory = _directory(connect, keys.check_name(fleet, "fleet name"))
    found = [directory / f"{prefix}{name}.log" for prefix in ("", "@")]
    path = next((each for each in found if each.parent == directory and _either(each)), None)
    if path is None:
        there = sorted({each.name.partition(".")[0].lstrip("@") for each in directory.glob("*.log*")})
        raise click.UsageError(f"there is no log of {name!r} in {directory}: there are {', '.join(there) or 'none'}")
    with signals.sigterm_interrupts():
        try:
            for line in _lines(path, follow=follow):
                click.echo(json.dumps(entry(line)) + "\n" if as_json else line, nl=False)
        except KeyboardInterrupt:
            raise SystemExit(startup.INTERRUPTED) from None


def _directory(connect: str | None, fleet: str) -> Path:
    """Of the run that is up, if it is on this machine, else of the newest."""
    try:
        with Bus.open(connect) as bus:
            for each in ask_status(bus, fleet):
                if Path(each.directory).is_dir():
                    return Path(each.directory)
    except BusError:
        pass  # nothing is up: the logs are files
    place = runs(fleet, resolve_endpoint(connect))
    newest = sorted(each for each in place.iterdir() if each.is_dir()) if place.is_dir() else []
    if not newest:
        raise click.ClickException(f"fleet {fleet} has never been up here: there is nothing in {place}")
    return newest[-1]


def _either(path: Path) -> bool:
    return path.exists() or path.with_suffix(".log.1").exists()


def _lines(path: Path, *, follow: bool) -> Iterator[str]:
    """The older file, then the newer; with `follow` what is added, also when the file is begun anew."""
    before = path.with_suffix(".log.1")
    if before.exists():
        with before.open(encoding="utf-8", errors="replace") as older:
            yield from older
    file = _opened(path, follow=follow)
    while file is not None:
        with file:
            while True:
                if line := file.readline():
                    yield line
                elif not follow:
                    return
                elif _moved(path, file):
                    break
                else:
                    time.sleep(LOOK_S)
        file = _opened(path, follow=follow)


def _opened(path: Path, *, follow: bool) -> IO[str] | None:
    while not path.exists():
        if not follow:
            return None
        time.sleep(LOOK_S)
    return path.open(encoding="utf-8", errors="replace")


def _moved(path: Path, file: IO[str]) -> bool:
    """Whether the open file is no longer the one under its name."""
    there = os.fstat(file.fileno())
    try:
        now = path.stat()
    except FileNotFoundError:
        return False  # between two files
    return (there.st_dev, there.st_ino) != (now.st_dev, now.st_ino)
