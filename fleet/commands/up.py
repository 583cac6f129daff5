"""`fleet up`: runs the supervisor of a fleet from its file, or of simulated cars, until Ctrl-C or detached."""

import asyncio
import json
import os
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import click
from msgspec.structs import replace

from fleet.client.hints import complete_hints
from fleet.commands.command_group import connect_option, fleet_option, remember_fleet
from fleet.commands.exit_code import cli_errors
from fleet.commands.params import Number
from fleet.coordinator.observer import listed_cars
from fleet.fleetfile.fleet_file import parse_fleet, read_fleet
from fleet.policy.lint.lint import find_faults
from fleet.policy.plan.plan_parser import parse as parse_plan
from fleet.recording.writing.disk_space import Reserve
from fleet.supervisor.spec import MAX_SIMULATED_CARS, FleetSpec, UpOptions, build_spec, coordinator_fleet_file
from fleet.supervisor.supervisor import CAR_STOP_RETRY_S, MISSING, READY, Supervisor, SupervisorEvent
from fleet.supervisor.supervisor_service import AnotherSupervisor
from schemas import keys
from schemas.bus import ENDPOINT_VARIABLE, accepts, check_listening, is_secure, resolve_endpoint
from schemas.local_time import clock
from schemas.process import signals, startup, stdio
from schemas.process.children import leave, start_detached
from schemas.yaml_document.document import read_text

DEFAULT_FILE: Final = Path("fleet.yaml")
_Write = Callable[[SupervisorEvent], None]


@click.command(
    epilog="""\b
examples:
  fleet up
  fleet up lab.yaml --plan plan.yaml
  fleet up --sim 8 --console     # with the web page
  fleet up --detach && fleet drive red forward --for 1s; fleet down

Without FILE and --sim, the file is ./fleet.yaml. The start ends with one line: all cars are ready, or which cars are
missing and why. With --sim and --json, lines on stdin go to the simulator (`gateway sim --help`). If a car cannot be
stopped at the end, new gateways try again to stop it until the next Ctrl-C.

With --detach the command returns when all cars and services are ready. It also returns if none of them becomes ready
for 30 s (10 s if only cars whose links cannot be opened are missing). In both cases the fleet keeps running:
`fleet logs supervisor` shows its log, `fleet down` ends it.

Exit codes: 0 every car was stopped (with --detach: all are ready), 1 a car was not, or nothing started, or not
everything was recorded, 2 wrong use."""
)
@click.argument("file", required=False, type=click.Path(path_type=Path, dir_okay=False))
@click.option("--sim", "simulated", type=Number(int, 1, MAX_SIMULATED_CARS),
              help="Simulate N cars: first the cars in the file, regardless of their links.")  # fmt: skip
@click.option(
    "--plan",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Run this plan (default: as in the fleet file).",
)
@click.option(
    "--world", type=click.Path(path_type=Path, dir_okay=False), help="Put the simulated cars into this world."
)
@click.option(
    "--record/--no-record",
    default=None,
    help="Record everything, or nothing (default: as in the fleet file, or record).",
)
@click.option(
    "--sessions",
    "out",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Write sessions to DIR (default: as in the fleet file, or sessions).",
)
@click.option("--console", is_flag=True, help="Also serve the fleet as a web page on this computer.")
@click.option("--console-port", type=Number(int, 1, 65535), help="Serve the web page at this port (default: 7480).")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object for each event.")
@connect_option("The bus, tcp/HOST:PORT (default: the file's, FLEET_ENDPOINT, the hub you joined, or port 7447 here).")
@fleet_option(default=None)
@click.option(
    "--insecure-lan",
    is_flag=True,
    help="Let the bus of --connect be open to a network. Everyone there can drive the cars.",
)
@click.option("--secure", is_flag=True, help="Use certificates, so that no other user of this computer can connect.")
@click.option("--detach", is_flag=True, help="Return when the cars are ready. The fleet runs until `fleet down`.")
@click.option("--detached", is_flag=True, hidden=True, help="Run as the process that --detach has started.")
def up(
    file: Path | None,
    simulated: int | None,
    plan: Path | None,
    world: Path | None,
    *,
    record: bool | None,
    out: Path | None,
    console: bool,
    console_port: int | None,
    as_json: bool,
    connect: str | None,
    fleet: str | None,
    insecure_lan: bool,
    secure: bool,
    detach: bool,
    detached: bool,
) -> None:
    """Start all processes of a fleet, show its cars, restart crashed processes. Ctrl-C stops every car, then exits."""
    if file is None and simulated is None:
        if not DEFAULT_FILE.exists():
            raise click.UsageError(
                "There is no fleet.yaml here. `fleet init` creates one; `fleet up --sim 3` needs none."
            )
        file = DEFAULT_FILE
    if detach:
        raise SystemExit(_run_detached(_own_arguments(), as_json=as_json))
    options = UpOptions(
        simulated or 0, plan, world, record, out, connect, fleet, insecure_lan, console, console_port or 0, secure
    )
    with cli_errors():
        if fleet is not None:
            keys.check_name(fleet, "fleet name")
        spec = read(file, options)
        remember_fleet(spec.endpoint if resolve_endpoint(spec.endpoint) != resolve_endpoint() else None, spec.fleet)
        for warning in spec.warnings:
            click.echo(f"fleet: {warning}", err=True)
        if not spec.cars:
            raise click.UsageError(f"{file} has no car with a link: `fleet bind` finds links, --sim {3} simulates cars")
        if spec.console:
            from fleet.commands.console import listen_or_fail  # needs an extra

            listen_or_fail(spec.console_port or None, "fleet up --console-port {other}").close()
        endpoint = resolve_endpoint(spec.endpoint)
        if not accepts(endpoint):  # then this `fleet up` starts the hub
            check_listening(endpoint, insecure_lan=insecure_lan)
        if spec.record and (why := Reserve().why_unwritable(spec.recordings)):
            raise click.ClickException(
                f"No session can be created in {spec.recordings}: {why}. "
                "Name another place with --sessions, or drive without a recording: --no-record."
            )
        try:
            stopped = asyncio.run(_serve(spec, file, options, as_json=as_json, detached=detached))
        except AnotherSupervisor as error:
            raise click.ClickException(str(error)) from None
        except OSError as error:
            raise click.ClickException(
                f"the logs cannot be written: {error}; set FLEET_STATE_DIR to another directory"
            ) from None
    raise SystemExit(0 if stopped else 1)


def read(file: Path | None, options: UpOptions) -> FleetSpec:
    """Return the spec of the fleet file and the options, with a checked plan. Raises ValueError."""
    spec = build_spec(None if file is None else read_fleet(file, unbound=options.simulated > 0), options)
    spec = _with_certificates(spec, secure=options.secure)
    for path in (spec.plan, spec.world):
        if path is None:
            continue
        text = read_text(path)
        if path is spec.plan:
            spec = _with_plan(spec, text)
    return spec


def _with_certificates(spec: FleetSpec, *, secure: bool) -> FleetSpec:
    """Return the spec with the endpoint of a hub with certificates, if one is here, or if `secure` asks for one."""
    endpoint = resolve_endpoint(spec.endpoint)
    if not secure and not is_secure(endpoint):
        return spec
    from fleet.hub import local_hub  # needs an extra

    if secure and not is_secure(endpoint):
        if not spec.endpoint and os.environ.get(ENDPOINT_VARIABLE):  # all other commands would use that bus
            raise click.UsageError(f"{ENDPOINT_VARIABLE} names a bus without certificates, {endpoint}: unset it")
        endpoint = f"tls/{endpoint.partition('/')[2]}"
    if secure or local_hub.is_hub_here(endpoint):
        try:
            local_hub.ensure_hub_here(endpoint, spec.cars)
        except OSError as error:
            raise click.ClickException(f"certificates cannot be created: {error}") from None
    return replace(spec, endpoint=endpoint)


def _with_plan(spec: FleetSpec, text: str) -> FleetSpec:
    """Return the spec with this plan. Raises ValueError, which names everything in the plan that can never work."""
    plan = parse_plan(text, str(spec.plan))
    # The coordinator reads the cars in the same way.
    cars = listed_cars(parse_fleet(coordinator_fleet_file(spec), Path("fleet.yaml"), unbound=True))
    found = find_faults(plan, cars)
    found.raise_errors(str(spec.plan))
    return replace(
        spec, plan_text=text, warnings=(*spec.warnings, *(f"{spec.plan}: {each}" for each in found.warnings))
    )


def _own_arguments() -> list[str]:
    """Return this command's arguments, without --detach."""
    context = click.get_current_context()
    words = []
    for param in context.command.params:
        value = context.params[param.name or ""]
        if param.name in ("detach", "as_json") or value in (None, False):
            continue
        if isinstance(param, click.Option):
            words.append(param.opts[0])
        if value is not True:
            words.append(str(value))
    if context.params["record"] is False:
        words.append("--no-record")
    return words


def _run_detached(arguments: Iterable[str], *, as_json: bool) -> int:
    """Run `fleet up` in a process of its own until its start has ended. Return the exit code."""
    command = [sys.executable, "-m", "fleet.cli", "up", *arguments, "--detached"]
    with signals.held_back():
        child = start_detached(command, output=subprocess.PIPE)
    try:
        code = _follow_start(child, as_json=as_json)
    except KeyboardInterrupt:
        child.terminate()  # the child stops every car first
        _follow_start(child, as_json=as_json)
        raise SystemExit(startup.INTERRUPTED) from None
    leave(child)
    return code


def _follow_start(child: "subprocess.Popen[str]", *, as_json: bool) -> int:
    """Print the messages of a detached process until its start has ended. Return the exit code."""
    assert child.stdout is not None
    with child.stdout as output:
        for line in output:
            try:
                event = json.loads(line)
                what, words = event["what"], event["words"]
            except (ValueError, KeyError, TypeError):  # not an event: an error about its arguments
                click.echo(line, nl=False, err=True)
                continue
            ended = what in (READY, MISSING)
            if as_json and ended:
                click.echo(line, nl=False)
            elif ended:
                click.echo(words, err=what == MISSING)
            elif what in ("hold", "end"):
                click.echo(f"{event['name']}: {words}", err=True)
            if ended:
                return 0 if what == READY else 1
    return child.wait() or 1


def _append_output_to(path: Path) -> None:
    """Append stdout and stderr to this file, because nobody reads the pipe any more."""
    sys.stdout.flush()
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    for stream in (sys.stdout, sys.stderr):
        os.dup2(file, stream.fileno())
    os.close(file)


async def _serve(
    spec: FleetSpec, file: Path | None, options: UpOptions, *, as_json: bool, detached: bool = False
) -> bool:
    loop = asyncio.get_running_loop()
    write = _json if as_json or detached else _plain
    live = sys.stdout.isatty() and not as_json

    def tell(event: SupervisorEvent) -> None:
        if detached and not supervisor.starting:  # the event is in the supervisor's log
            return
        if detached and event.what in (READY, MISSING):
            event = replace(event, words=complete_hints(f"{event.words} `fleet down` ends it.", supervisor.options))
        _print_event(write, event) if table is None else table.on_event(event)
        if detached and event.what in (READY, MISSING):
            _append_output_to(supervisor.log_path)

    supervisor = Supervisor(spec, str(file) if file else "", lambda: read(file, options), tell)
    table = None
    if live:
        from fleet.supervisor.status_table import Table

        table = Table(supervisor)

    def end(number: signal.Signals) -> None:
        match number:
            case signal.SIGINT:
                supervisor.end("Ctrl-C")
            case signal.SIGTERM:
                supervisor.end("SIGTERM", CAR_STOP_RETRY_S)
            case _:
                supervisor.end("the terminal was closed", CAR_STOP_RETRY_S)

    signals.calls_in(loop, end)
    if as_json and spec.simulated:
        await _pass_stdin(loop, supervisor.tell_simulator)
    if table is None:
        return await supervisor.run()
    with table:
        drawing = asyncio.ensure_future(table.draw())
        try:
            return await supervisor.run()
        finally:
            drawing.cancel()
            await asyncio.gather(drawing, return_exceptions=True)


class LineProtocol(asyncio.Protocol):
    """Calls `on_line` for each line from stdin."""

    def __init__(self, on_line: Callable[[str], None]) -> None:
        self._on_line = on_line
        self._rest = b""

    def data_received(self, data: bytes) -> None:
        """Split the bytes into lines."""
        *whole, rest = (self._rest + data).split(b"\n")
        self._rest = rest[-65536:]
        for line in whole:
            if line.strip():
                self._on_line(line.decode("utf-8", "replace"))


async def _pass_stdin(loop: asyncio.AbstractEventLoop, take: Callable[[str], None]) -> None:
    """Pass lines from stdin to the simulator, if stdin is a pipe or socket."""
    mode = os.fstat(sys.stdin.fileno()).st_mode
    if stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode):
        await loop.connect_read_pipe(lambda: LineProtocol(take), sys.stdin)


def _print_event(write: _Write, event: SupervisorEvent) -> None:
    """Print an event. A closed pipe or terminal must not prevent the shutdown."""
    try:
        write(event)
    except OSError:
        stdio.silence(sys.stdout)


def _json(event: SupervisorEvent) -> None:
    now = datetime.now(UTC).isoformat(timespec="milliseconds")
    click.echo(json.dumps({"time": now, "what": event.what, "name": event.name, "words": event.words}))


def _plain(event: SupervisorEvent) -> None:
    name = "" if event.what in (READY, MISSING) else f"{event.name}: "
    click.echo(f"{clock(time.time())} {name}{event.words}")
