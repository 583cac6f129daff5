"""`fleet status, down, reload, logs`: commands for a running fleet, from another terminal."""

import json
import os
import time
from collections.abc import Iterator
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from typing import IO, Any, Final

import click

from fleet.client.claims import may_still_move
from fleet.client.client import certified_sender
from fleet.client.services import ask_recorder
from fleet.client.supervision import SUPERVISOR_STATUS, ask_status
from fleet.commands.command_group import chosen_person, say
from fleet.commands.exit_code import not_running
from fleet.commands.observe import show_cars
from fleet.commands.options import bus_options, json_option
from fleet.commands.which_fleet import client_in, find_fleet
from fleet.supervisor.log_files import parse_log_line, runs_directory
from fleet.supervisor.supervisor_service import ask_service
from schemas import keys, messages
from schemas.bus import Bus, BusError, Failure, messages_of, resolve_endpoint
from schemas.process import signals, startup
from schemas.suggestion import did_you_mean
from schemas.words import Phase, RecorderVerb, RunState

FLEET_DOWN_TIMEOUT_S: Final = 120.0
"""Timeout for the shutdown: enough for the longest stop of a car, and for a recorder that writes its buffers."""
SUPERVISOR_LOST_S: Final = 10.0
"""Time without a status and without a token after which the supervisor counts as ended.

On a machine that stalls, Zenoh cuts a process off after 2 s. The tokens of the process are gone until it is connected
again.
"""
FLEET_DOWN_POLL_S: Final = 0.2
LOG_POLL_S: Final = 0.2


@click.command(epilog="\b\nexamples:\n  fleet status\n  fleet status --processes")
@click.option("--processes", is_flag=True, help="Show every process, with its id and restarts.")
@json_option
@bus_options
def status(connect: str | None, fleet: str, *, processes: bool, as_json: bool) -> None:
    """Show the fleet and its session, then the cars, then which cars and services are not ready, and why."""
    keys.check_name(fleet, "fleet name")
    with Bus.open(connect) as bus:
        fleet = find_fleet(bus, fleet)
        found = ask_status(bus, fleet)
        if not found:
            raise not_running(fleet, connect)
        is_recorded = any(each.session and not each.unrecorded for each in found)
        warning = _warning_of_recorder(bus, fleet) if is_recorded and not as_json else ""
    for each in found:
        if as_json:
            click.echo(messages.to_json(each))
            continue
        where = f"recording to {each.session}" if each.session and not each.unrecorded else "not recording"
        what = each.fleet_file or "simulated cars"
        click.echo(
            f"{keys.describe_fleet(fleet)} ({what}): {each.state} for {timedelta(seconds=int(each.uptime_s))}, {where}"
        )
        if processes:
            click.echo(f"supervisor: process {each.pid} on {each.host}, logs in {each.directory}")
            for process in each.processes:
                click.echo(_describe_process(process))
            continue
        with client_in(connect, fleet) as client:
            show_cars(client)
        for name, why in each.missing.items():
            if name == keys.RECORDER and each.unrecorded:
                continue
            say(f"not ready: {name.lstrip('@')} ({why})")
        if each.unrecorded:
            say(f"not recorded: {each.unrecorded}")
    if warning:
        say(f"recorder: {warning}")


def _warning_of_recorder(bus: Bus, fleet: str) -> str:
    """Return the recorder's warning, for example that marked sessions exceed the quota. Empty if there is none."""
    found = ask_recorder(bus, fleet, RecorderVerb.STATUS)
    return "" if found is None or isinstance(found, Failure) else str(found.warning)


def _describe_process(process: Any) -> str:
    pid = f"process {process.pid}" if process.HasField("pid") else "no process"
    if process.state == RunState.ELSEWHERE:  # the words say which program does its work
        why = f": {process.words}"
    elif process.restarts:
        times = "once" if process.restarts == 1 else f"{process.restarts} times"
        why = f", started again {times}: {process.words}"
    else:
        why = f": {process.words}" if process.words else ""
    return f"  {process.name:14} {process.state:9} {process.since_s:6.0f} s  {pid}{why}"


@click.command(epilog="\b\nexample:\n  fleet down")
@json_option
@bus_options
def down(connect: str | None, fleet: str, *, as_json: bool) -> None:
    """Stop every car and end `fleet up`, as Ctrl-C in its terminal does. Wait, and print the result for each car."""
    keys.check_name(fleet, "fleet name")
    with Bus.open(connect) as bus:
        received: list[Any] = []
        fleet = find_fleet(bus, fleet)
        bus.subscribe(f"{fleet}/{SUPERVISOR_STATUS.name}", lambda sample: received.extend(messages_of([sample])))
        sender = certified_sender(bus.identity, person=chosen_person())
        if not ask_status(bus, fleet) or (answer := ask_service(bus, fleet, "down", sender)) is None:
            raise not_running(fleet, connect)
        if answer.status == Phase.REJECTED:
            raise click.ClickException(answer.words)
        last, gone = _until_ended(bus, fleet, received)
    results = dict(last.became) if last is not None else {}
    ended = last is not None and last.state == RunState.ENDED
    bad = sorted(car for car, words in results.items() if may_still_move(words))
    unrecorded = last.unrecorded if last is not None else ""
    if as_json:
        click.echo(json.dumps({"ended": ended, "cars": results, "unrecorded": unrecorded}))
    else:
        for car, words in sorted(results.items()):
            say(f"{car}: {words}", err=car in bad)
        if unrecorded:
            click.echo(f"not everything was recorded: {unrecorded}", err=True)
    if not ended:
        what = "ended without reporting" if gone else f"has not ended after {FLEET_DOWN_TIMEOUT_S:g} s"
        raise click.ClickException(
            f"`fleet up` {what}. Cars may still be moving: check them. "
            "Then type `fleet status` and `fleet logs supervisor`."
        )
    raise SystemExit(1 if bad or unrecorded else 0)


def _until_ended(bus: Bus, fleet: str, received: list[Any]) -> tuple[Any, bool]:
    """Wait for the end of the shutdown. Return the last status, and whether the supervisor is gone."""
    deadline = time.monotonic() + FLEET_DOWN_TIMEOUT_S
    last_sign_at = time.monotonic()  # a new status, or the supervisor's token on the bus, is a sign of life
    count, gone = 0, False
    while time.monotonic() < deadline and not gone:
        if len(received) != count:
            count, last_sign_at = len(received), time.monotonic()
            if received[-1].state == RunState.ENDED:
                break
        elif bus.tokens(keys.car_token(fleet, keys.SUPERVISOR)):
            last_sign_at = time.monotonic()
        gone = time.monotonic() - last_sign_at > SUPERVISOR_LOST_S
        time.sleep(FLEET_DOWN_POLL_S)
    return received[-1] if received else None, gone


@click.command(
    epilog="""\b
example:
  fleet reload

Exit codes: 0 every change is in force, 1 some need a restart, or no fleet runs, 2 nothing changed, such as with a wrong
file."""
)
@json_option
@bus_options
def reload(connect: str | None, fleet: str, *, as_json: bool) -> None:
    """Read the fleet file again, and apply changes of cars and plan. Print which changes need a restart."""
    keys.check_name(fleet, "fleet name")
    with Bus.open(connect) as bus:
        fleet = find_fleet(bus, fleet)
        answer = ask_service(bus, fleet, "reload", certified_sender(bus.identity, person=chosen_person()))
        if answer is None:
            raise not_running(fleet, connect)
    if as_json:
        click.echo(messages.to_json(answer))
    else:
        say(answer.words, err=answer.status != Phase.SENT)
    raise SystemExit({Phase.REJECTED: 2, Phase.FAILED: 1}.get(answer.status, 0))


def _complete_logs(ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[str]:
    """Complete, in the shell, the name of a car or service that has a log of the last run on this machine."""
    fleet = ctx.params.get("fleet") or ctx.find_root().params.get("fleet") or keys.DEFAULT_FLEET
    connect = ctx.params.get("connect") or ctx.find_root().params.get("connect")
    with suppress(click.ClickException, ValueError, OSError):
        return [name for name in _names_of_logs(_last_run(connect, fleet)) if name.startswith(incomplete)]
    return []


def _names_of_logs(directory: Path) -> list[str]:
    """Return the cars and services that have a log in this directory."""
    return sorted({each.name.partition(".")[0].lstrip("@") for each in directory.glob("*.log*")})


@click.command(epilog="\b\nexamples:\n  fleet logs red\n  fleet logs recorder --follow\n  fleet logs red --json")
@click.argument("name", metavar="CAR|SERVICE", shell_complete=_complete_logs)
@click.option("-f", "--follow", is_flag=True, help="Print new lines until Ctrl-C.")
@json_option
@bus_options
def logs(name: str, connect: str | None, fleet: str, *, follow: bool, as_json: bool) -> None:
    """Show the log of a car's gateway or of a service, from the current or the last run.

    Services: supervisor, hub, simulator, coordinator, recorder, console. One that has logged nothing has no log.
    """
    directory = _log_directory(connect, keys.check_name(fleet, "fleet name"))
    candidates = [directory / f"{prefix}{name}.log" for prefix in ("", "@")]
    # Only files of this directory: a name with a `/` could lead to another one.
    path = next((each for each in candidates if each.parent == directory and _has_log(each)), None)
    if path is None:
        there = _names_of_logs(directory)
        near = did_you_mean(name, there) or f"There are: {', '.join(there) or 'none'}."
        raise click.UsageError(f'There is no log of "{name}". {near}')
    with signals.sigterm_interrupts():
        try:
            for line in _lines(path, follow=follow):
                click.echo(json.dumps(parse_log_line(line)) + "\n" if as_json else line, nl=False)
        except KeyboardInterrupt:
            raise SystemExit(startup.INTERRUPTED) from None


def _log_directory(connect: str | None, fleet: str) -> Path:
    """Return the log directory of the running fleet if it is on this machine, else of the last run."""
    try:
        with Bus.open(connect) as bus:
            fleet = find_fleet(bus, fleet)
            for each in ask_status(bus, fleet):
                if Path(each.directory).is_dir():
                    return Path(each.directory)
    except BusError:
        pass  # no fleet runs, but the files of its last run may be here
    return _last_run(connect, fleet)


def _last_run(connect: str | None, fleet: str) -> Path:
    """Return the log directory of the last run on this machine."""
    place = runs_directory(fleet, resolve_endpoint(connect))
    # If `fleet up` refused to start anything, its directory has no logs.
    runs = sorted(each for each in place.iterdir() if any(each.glob("*.log"))) if place.is_dir() else []
    if not runs:
        raise click.ClickException(f"No logs yet: {keys.describe_fleet(fleet)} has not run here. `fleet up` starts it.")
    return runs[-1]


def _has_log(path: Path) -> bool:
    """Return True if there is a log of this name. Directly after a rollover there is only the older file, `.log.1`."""
    return path.exists() or path.with_suffix(".log.1").exists()


def _lines(path: Path, *, follow: bool) -> Iterator[str]:
    """Yield the lines of the older and the newer file. With `follow`, yield new lines, also after a rollover."""
    before = path.with_suffix(".log.1")
    if before.exists():
        with before.open(encoding="utf-8", errors="replace") as older:
            yield from older
    file = _open_log(path, follow=follow)
    while file is not None:
        with file:
            while True:
                if line := file.readline():
                    yield line
                elif not follow:
                    return
                elif _is_rolled_over(path, file):
                    break
                else:
                    time.sleep(LOG_POLL_S)
        file = _open_log(path, follow=follow)


def _open_log(path: Path, *, follow: bool) -> IO[str] | None:
    while not path.exists():
        if not follow:
            return None
        time.sleep(LOG_POLL_S)
    return path.open(encoding="utf-8", errors="replace")


def _is_rolled_over(path: Path, file: IO[str]) -> bool:
    """Return True if another file now has the name of the open file."""
    there = os.fstat(file.fileno())
    try:
        now = path.stat()
    except FileNotFoundError:
        return False  # the log was renamed, and its process creates the new file when it logs the next line
    return (there.st_dev, there.st_ino) != (now.st_dev, now.st_ino)
