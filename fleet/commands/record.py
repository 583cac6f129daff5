"""`fleet record` and `fleet mark`: runs the recorder as a process, and sends commands to a running recorder."""

import json
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from fleet.client.client import certified_sender, default_sender
from fleet.client.services import RECORDER_TIMEOUT_S, ask_recorder, site_recordings, why_unrecorded
from fleet.commands.command_group import (
    DefaultCommandGroup,
    chosen_person,
    connect_option,
    fleet_option,
    say,
    starter_option,
)
from fleet.commands.options import bus_options, json_option
from fleet.commands.output import echo_safely
from fleet.commands.params import Choice, Duration
from fleet.commands.which_fleet import find_fleet
from fleet.quota import Quota, parse_size
from fleet.recording.session_lookup import DEFAULT_SESSIONS
from fleet.recording.writing.disk_space import Reserve
from fleet.recording.writing.recorder_service import AnotherRecorder
from schemas import keys
from schemas.bus import BadEndpoint, Bus, BusError, Failure, HubKeeper
from schemas.identity import Service, service
from schemas.printable import printable_lines
from schemas.process import signals
from schemas.process.parent import has_ended, watched_pid
from schemas.words import RecorderState, RecorderVerb

if TYPE_CHECKING:
    from fleet.fleetfile.fleet_file import PinRule
    from fleet.recording.writing.recorder import Recorder
    from schemas.rights import People

POLL_INTERVAL_S: Final = 0.25
_WEEK_S: Final = 7 * 86_400.0


class SizeType(click.ParamType[int]):
    """An amount of data: `512MB`, `1.5GB`, or a number of bytes."""

    name = "SIZE"

    def __init__(self, least: int) -> None:
        self._least = least

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Return the number of bytes. Fail outside the range."""
        size = parse_size(str(value))
        if size is None or not self._least <= size <= 10**15:
            least = f"{self._least / 10**6:g} MB" if self._least else "0"
            self.fail(f"{value!r} is not allowed: {least} to 1000 TB, as 512MB, 1.5GB or a number of bytes", param, ctx)
        return size


_FILE: Final = click.Path(path_type=Path, dir_okay=False)


@click.group(
    cls=DefaultCommandGroup,
    default_command="run",
    epilog="""\b
examples:
  fleet record                  # record until Ctrl-C, as `fleet record run`
  fleet record --quota 20GB
  fleet record status
  fleet mark "the blue one lost the line"

`fleet up` records by itself. `fleet record run -h` shows the options.""",
)
def record() -> None:
    """Record without `fleet up`, and command a recorder that runs. Without a command: record until Ctrl-C."""


@record.command(
    epilog="""\b
examples:
  fleet record run --quota 20GB
  fleet record run --sessions /media/disk --segment-time 5m
  fleet record run --site north

The quota removes whole files, the oldest of all sessions first. It removes pinned files last: those around
stops, marks, and times when a condition under `pin:` in the fleet file was true. It never removes files of
marked sessions."""
)
@click.option(
    "--sessions",
    "place",
    default=DEFAULT_SESSIONS,
    show_default=True,
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Create the session's directory in DIR.",
)
@click.option(
    "--segment-size", type=SizeType(10**6), default="512MB", show_default=True, help="Maximum size of a file."
)
@click.option(
    "--segment-time",
    type=Duration(_WEEK_S),
    help="Start a new file after this time (default: 10m; with --quota: 1m, because the quota removes whole files).",
)
@click.option(
    "--sync",
    type=Choice("time to sync", ("never", "segment", "second")),
    default="segment",
    show_default=True,
    help="How often data is forced to disk. This matters only if the whole computer crashes.",
)
@click.option(
    "--session-size",
    type=SizeType(10**6),
    help="Maximum size of a session, after which the next session begins. With --quota: at most half of the quota "
    "(default: a tenth of it).",
)
@click.option(
    "--quota",
    type=SizeType(10**6),
    help="Maximum size of all sessions in --sessions. Beyond it, the oldest files are removed, pinned ones last.",
)
@click.option(
    "--keep-free",
    type=SizeType(0),
    default="50MB",
    show_default=True,
    help="Minimum free disk space. With less, recording pauses until there is room again.",
)
@click.option(
    "--fleet-file",
    type=_FILE,
    help="Copy this file into the session as fleet.yaml, and pin the conditions under `pin:` in it.",
)
@click.option("--plan", type=_FILE, help="Copy this file into the session as plan.yaml.")
@click.option(
    "--site",
    default="",
    metavar="SITE",
    help="Record at this site. While the main recorder is reachable, it answers all commands.",
)
@connect_option()
@fleet_option()
@starter_option()
@click.option("--json", "as_json", is_flag=True, help="One JSON object per line: when ready, and at the end.")
def run(
    place: Path,
    segment_size: int,
    segment_time: float | None,
    sync: str,
    session_size: int | None,
    quota: int | None,
    keep_free: int,
    fleet_file: Path | None,
    plan: Path | None,
    site: str,
    connect: str | None,
    fleet: str,
    *,
    starter: int | None,
    as_json: bool,
) -> None:
    """Record everything of a fleet until Ctrl-C. Print the session's directory when the recorder is ready."""
    from fleet.recording.session_dir import FLEET_FILE, PLAN_FILE
    from fleet.recording.writing.recorder import Recorder, RecordingFailed
    from fleet.recording.writing.session_writer import Options, Sync

    copied = {FLEET_FILE: fleet_file, PLAN_FILE: plan}
    size_limits = Quota(quota or 0, session_size or 0)
    if size_limits.refusal:
        raise click.UsageError(size_limits.refusal)
    if segment_time is None:
        segment_time = size_limits.segment_s(Options().segment_s)
    options = Options(
        segment_bytes=segment_size,
        segment_s=segment_time,
        sync=Sync(sync),
        quota=size_limits,
        reserve=Reserve(keep_free),
        copied={name: path for name, path in copied.items() if path is not None},
    )
    parent = watched_pid(starter)
    stop = threading.Event()
    signals.calls(stop.set)
    try:
        identity = service(Service.RECORDER, keys.check_name(site, "site") if site else "")
        with Bus.open(connect, start_hub=True, identity=identity) as bus:
            pins, people = _pins_and_people(fleet_file)
            recorder = Recorder(bus, fleet, place, options, site=site, pins=pins, people=people, notify=_warn)
            session = _start(recorder, place)
            try:
                _say_begun(fleet, session, recorder.full, as_json=as_json)
                _wait(bus, stop, recorder.ended, parent)
            finally:  # or its threads would keep this process for ever, if nobody reads what it says
                outcome = recorder.close()
    except (BadEndpoint, keys.BadKey) as error:
        raise click.UsageError(str(error)) from None
    except (BusError, AnotherRecorder, RecordingFailed) as error:
        raise click.ClickException(str(error)) from None
    session = outcome.session  # a new session may have begun meanwhile
    _say(
        as_json,
        {
            "session": str(session),
            "state": RecorderState.CLOSED,
            "messages": outcome.messages,
            "bytes": outcome.bytes,
            "drops": dict(outcome.drops),
            "missed": dict(outcome.missed),
        },
        f"{session}: {outcome.messages} messages, {outcome.bytes} bytes, "
        f"{_count(outcome.drops, 'dropped here')}, {_count(outcome.missed, 'missed on the bus')}",
    )
    if outcome.error:
        raise click.ClickException(outcome.error)


def _start(recorder: "Recorder", place: Path) -> Path:
    try:
        return recorder.start()
    except OSError as error:
        raise click.ClickException(
            f"No session can be created in {place}: {error.strerror}. Name another place with --sessions."
        ) from None


def _say_begun(fleet: str, session: Path, full: str, *, as_json: bool) -> None:
    if full:
        values = {"session": str(session), "state": RecorderState.FULL}
        _say(as_json, values, f"{keys.describe_fleet(fleet)} is not recorded until there is room: {full}")
    else:
        values = {"session": str(session), "state": RecorderState.RECORDING}
        _say(as_json, values, f"recording {keys.describe_fleet(fleet)} to {session}")


def _wait(bus: Bus, stop: threading.Event, ended: threading.Event, parent: int | None) -> None:
    """Wait until a signal, a failure of the recorder or the end of the parent. Restart a lost hub meanwhile."""
    hub_keeper = HubKeeper(bus.endpoint, _warn)
    while not stop.wait(POLL_INTERVAL_S) and not ended.is_set() and not has_ended(parent):
        hub_keeper.check(connected=bus.connected)


def _say(as_json: bool, values: dict[str, Any], words: str) -> None:  # noqa: FBT001 - the flag of the command
    click.echo(json.dumps(values) if as_json else words)


def _pins_and_people(fleet_file: Path | None) -> "tuple[tuple[PinRule, ...], Callable[[], People | None]]":
    """Return the pin rules of a fleet file, and a function that reads the people of the file again at each call.

    If the file has mistakes, there are no rules, and the recording continues without pins.
    """
    from fleet.fleetfile.fleet_file import people_table, read_fleet, read_people

    if fleet_file is None:
        return (), lambda: None

    def people() -> "People | None":
        listed = read_people(fleet_file)
        return None if listed is None else people_table(listed)

    try:
        # Only the rules count here: cars without a link, or a plan that is not beside the file, do no harm.
        return read_fleet(fleet_file, unbound=True, moved=True).pins, people
    except ValueError as error:  # BadFile is a ValueError
        _warn(f"the conditions under pin: in {fleet_file} are not used: {error}")
        return (), people


def _warn(words: str) -> None:
    click.echo(f"fleet record: {words}", err=True)


def _count(lost: Mapping[str, int], what: str) -> str:
    if not lost:
        return f"none {what}"
    worst = max(lost, key=lambda key: lost[key])
    return f"{sum(lost.values())} {what} (most on {worst}: {lost[worst]})"


def _connect_and_ask(verb: str, connect: str | None, fleet: str, **fields: str) -> Any:
    """Connect to the bus, then do as `_ask`."""
    keys.check_name(fleet, "fleet name")
    with Bus.open(connect) as bus:
        return _ask(bus, find_fleet(bus, fleet), verb, **fields)


def _ask(bus: Bus, fleet: str, verb: str, **fields: str) -> Any:
    """Send a command to the recorder of this fleet and return its status. Raises click's errors."""
    fields["sender"] = certified_sender(bus.identity, person=chosen_person())
    answer = ask_recorder(bus, fleet, verb, **fields)
    if isinstance(answer, Failure) and answer.is_timeout:
        raise click.ClickException(
            f"The recorder has not answered within {RECORDER_TIMEOUT_S:g} s: its disk is slow, or it hangs. It may "
            f"still do what you asked ({verb}). `fleet record status` shows its state."
        )
    if isinstance(answer, Failure):
        raise click.ClickException(f"the recorder says: {answer.words}")
    if answer is not None:
        return answer
    raise click.ClickException(
        f"No recorder of {keys.describe_fleet(fleet)} is on the bus at {bus.endpoint}. `fleet record` starts one."
    )


def _show_status(found: Any, *, as_json: bool, site: str = "") -> None:
    if as_json:
        from google.protobuf.json_format import MessageToDict

        named = {"site": site} if site else {}
        click.echo(json.dumps({**named, **MessageToDict(found, preserving_proto_field_name=True)}))
        return
    where = f"{site}: " if site else ""
    echo_safely(
        f"{where}{found.state}: {found.session}, {found.messages} messages, {found.bytes / 1e6:.1f} MB in "
        f"{found.segments} file{'s' * (found.segments != 1)}, {found.free_bytes / 1e9:.1f} GB free"
    )
    for counts, words in ((found.drops, "dropped for lack of room"), (found.missed, "missed on the bus")):
        if counts:
            worst = max(counts, key=lambda key: counts[key])
            echo_safely(f"{sum(counts.values())} {words}, most of {worst}: {counts[worst]}")
    if found.recovered:
        echo_safely(f"{sum(found.recovered.values())} were missed at first, and recorded later from their publishers")
    for words in (found.error, found.warning):
        if words:
            say(printable_lines(words))


@record.command(epilog="\b\nexample:\n  fleet record start")
@json_option
@bus_options
def start(connect: str | None, fleet: str, *, as_json: bool) -> None:
    """Start a new session after `fleet record stop`."""
    _show_status(_connect_and_ask(RecorderVerb.START, connect, fleet), as_json=as_json)


@record.command(epilog="\b\nexample:\n  fleet record stop")
@json_option
@bus_options
def stop(connect: str | None, fleet: str, *, as_json: bool) -> None:
    """Close the session. The recorder keeps running and waits for `fleet record start`."""
    _show_status(_connect_and_ask(RecorderVerb.STOP, connect, fleet), as_json=as_json)


@record.command(epilog="\b\nexample:\n  fleet record status")
@json_option
@bus_options
def status(connect: str | None, fleet: str, *, as_json: bool) -> None:
    """Show the recording of each site: its directory, how much was lost, and whether there is room."""
    keys.check_name(fleet, "fleet name")
    with Bus.open(connect) as bus:
        fleet = find_fleet(bus, fleet)
        first = _ask(bus, fleet, RecorderVerb.STATUS)
        _show_status(first, as_json=as_json)
        for site, found in site_recordings(bus, fleet):
            if found.session != first.session:  # otherwise this recorder has already answered above
                _show_status(found, as_json=as_json, site=site)


@click.command(epilog="\b\nexample:\n  fleet mark 'the blue one lost the line'")
@click.argument("text", metavar="WORDS")
@click.option("--by", metavar="NAME", help="Author of the mark (default: your name as a sender).")
@bus_options
def mark(text: str, by: str | None, connect: str | None, fleet: str) -> None:
    """Add a note to the running recording. The quota does not remove a marked session."""
    from fleet.recording.session_dir import MAX_MARK_CHARACTERS

    if not text.strip() or len(text) > MAX_MARK_CHARACTERS:
        raise click.UsageError(f"A note must have 1 to {MAX_MARK_CHARACTERS} characters, and more than blanks")
    found = _connect_and_ask(RecorderVerb.MARK, connect, fleet, text=text, by=by or default_sender(chosen_person()))
    if why := why_unrecorded(found):
        raise click.ClickException(f"The mark is not in a file yet: {why}. `fleet record status` shows when it is.")
    click.echo(f"marked in {found.session}")
