"""`fleet record`: the recorder as a process. What it records is recorder.py's; what it is asked, asking.py's."""

import json
import os
import re
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import click
from click.core import ParameterSource

from fleet.commands import record_control
from fleet.commands.params import DurationType
from schemas import keys
from schemas.bus import BadEndpoint, Bus, BusError, ensure_hub
from schemas.process import signals

LOOK_S: Final = 0.25
ALONE_S: Final = 0.5
"""Without a link for this long: see that there is a hub."""
DEFAULT_OUT: Final = "sessions"


_UNITS: Final = {"": 1, "B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
_WEEK_S: Final = 7 * 86_400.0


class SizeType(click.ParamType[int]):
    """An amount of data: `512MB`, `1.5GB`, or a number of bytes."""

    name = "SIZE"

    def __init__(self, least: int) -> None:
        self._least = least

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Bytes; fails outside the range."""
        match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)\s*([KMGT]?B|)", str(value).upper())
        size = int(float(match[1]) * _UNITS[match[2]]) if match else -1
        if not self._least <= size <= 10**15:
            least = f"{self._least / 10**6:g} MB" if self._least else "0"
            self.fail(f"{value!r} is not allowed: {least} to 1000 TB, as 512MB, 1.5GB or a number of bytes", param, ctx)
        return size


_FILE: Final = click.Path(path_type=Path, dir_okay=False)


@click.group(
    invoke_without_command=True,
    epilog="""\b
examples:
  fleet record --out sessions --quota 20GB
  fleet record status
  fleet mark "the blue one lost the line"

What was marked is spared by the quota.""",
)
@click.option(
    "--out",
    default=DEFAULT_OUT,
    show_default=True,
    type=click.Path(path_type=Path, file_okay=False),
    help="Directory in which the session's own directory is made.",
)
@click.option(
    "--segment-size", type=SizeType(10**6), default="512MB", show_default=True, help="A file has at most so much."
)
@click.option(
    "--segment-time", type=DurationType(_WEEK_S), default="10m", show_default=True, help="... and is at most so long."
)
@click.option(
    "--sync",
    type=click.Choice(("never", "segment", "second")),
    default="segment",
    show_default=True,
    help="When the disk is waited for. A crash of the recorder costs a second at most, whatever this is; one of the "
    "computer costs what was not synced.",
)
@click.option(
    "--session-size",
    type=SizeType(10**6),
    help="A session that has so much is closed, and the next one begins; with --quota half of it at "
    "most, and if this is not given a tenth.",
)
@click.option(
    "--quota",
    type=SizeType(10**6),
    help="What all sessions in --out may have; the oldest that nobody marked are removed.",
)
@click.option(
    "--keep-free",
    type=SizeType(0),
    default="50MB",
    show_default=True,
    help="With less than that on the disk, recording waits until there is room again.",
)
@click.option("--fleet-file", type=_FILE, help="Copied into the session, as fleet.yaml.")
@click.option("--plan", type=_FILE, help="Copied into the session, as plan.yaml.")
@click.option("--connect", metavar="ENDPOINT", help="The fleet's bus, e.g. tcp/127.0.0.1:7447.")
@click.option("--fleet", default=keys.DEFAULT_FLEET, show_default=True, help="Name of the fleet.")
@click.option("--with-parent", is_flag=True, help="End when the process that started this ends.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object per line: when ready, and at the end.")
@click.pass_context
def record(
    ctx: click.Context,
    out: Path,
    segment_size: int,
    segment_time: float,
    sync: str,
    session_size: int | None,
    quota: int | None,
    keep_free: int,
    fleet_file: Path | None,
    plan: Path | None,
    connect: str | None,
    fleet: str,
    *,
    with_parent: bool,
    as_json: bool,
) -> None:
    """Record everything of a fleet to MCAP until Ctrl-C; prints the session's directory once nothing can be missed."""
    if ctx.invoked_subcommand is not None:
        asked = [name for name in ctx.params if ctx.get_parameter_source(name) is not ParameterSource.DEFAULT]
        if asked:
            option = "--json" if asked[0] == "as_json" else f"--{asked[0].replace('_', '-')}"
            raise click.UsageError(f"{option} goes behind {ctx.invoked_subcommand!r}, if it has it", ctx)
        return
    from fleet.recording.session_dir import FLEET_FILE, PLAN_FILE
    from fleet.recording.writing.recorder import AnotherRecorder, Recorder, RecordingFailed
    from fleet.recording.writing.session_writer import Options, Sync

    copied = {FLEET_FILE: fleet_file, PLAN_FILE: plan}
    if session_size and quota and session_size > quota // 2:
        raise click.BadParameter(
            f"{session_size / 10**6:g} MB is more than half of --quota, which is kept by removing whole sessions: "
            f"at most {quota / 2 / 10**6:g} MB are allowed",
            ctx,
            param_hint="--session-size",
        )
    options = Options(
        segment_bytes=segment_size,
        segment_s=segment_time,
        sync=Sync(sync),
        session_bytes=session_size or 0,
        root_bytes=quota or 0,
        keep_free_bytes=keep_free,
        copied={name: path for name, path in copied.items() if path is not None},
    )
    parent = os.getppid() if with_parent else None
    stop = threading.Event()
    signals.calls(stop.set)
    try:
        with Bus.open(connect, start_hub=True) as bus:
            recorder = Recorder(bus, fleet, out, options, notify=_warn)
            session = recorder.start()
            if full := recorder.full:
                _say(as_json, {"session": str(session), "state": "full"}, f"fleet {fleet} waits for room: {full}")
            else:
                _say(as_json, {"session": str(session), "state": "recording"}, f"recording fleet {fleet} to {session}")
            _wait(bus, stop, recorder.ended, parent)
            outcome = recorder.close()
    except (BadEndpoint, keys.BadKey) as error:
        raise click.UsageError(str(error)) from None
    except (BusError, AnotherRecorder, RecordingFailed) as error:
        raise click.ClickException(str(error)) from None
    except OSError as error:
        raise click.ClickException(
            f"no session can be made in {out}: {error.strerror}; name another with --out"
        ) from None
    lost = {"drops": dict(outcome.drops), "missed": dict(outcome.missed)}
    session = outcome.session  # it may be another by now
    _say(
        as_json,
        {"session": str(session), "state": "closed", "messages": outcome.messages, "bytes": outcome.bytes, **lost},
        f"{session}: {outcome.messages} messages, {outcome.bytes} bytes, "
        f"{_count(outcome.drops, 'dropped here')}, {_count(outcome.missed, 'missed on the bus')}",
    )
    if outcome.error:
        raise click.ClickException(outcome.error)


def _wait(bus: Bus, stop: threading.Event, ended: threading.Event, parent: int | None) -> None:
    """Until told to stop, the recorder failed, or `parent` ended; meanwhile see that there is a hub."""
    linked = time.monotonic()
    while not stop.wait(LOOK_S) and not ended.is_set() and parent in (None, os.getppid()):
        if bus.connected:
            linked = time.monotonic()
        elif time.monotonic() - linked > ALONE_S:
            try:
                ensure_hub(bus.endpoint)
            except BusError as error:
                click.echo(f"fleet record: {error}", err=True)
            linked = time.monotonic()


def _say(as_json: bool, values: dict[str, Any], words: str) -> None:  # noqa: FBT001 - the flag of the command
    click.echo(json.dumps(values) if as_json else words)


def _warn(words: str) -> None:
    click.echo(f"fleet record: {words}", err=True)


def _count(lost: Mapping[str, int], what: str) -> str:
    if not lost:
        return f"none {what}"
    worst = max(lost, key=lambda key: lost[key])
    return f"{sum(lost.values())} {what} (most on {worst}: {lost[worst]})"


record.add_command(record_control.start)
record.add_command(record_control.stop)
record.add_command(record_control.status)
