"""`fleet record`: the recorder as a process. What it records is recorder.py's."""

import json
import os
import signal
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from types import FrameType
from typing import Any, Final

import click

from schemas import keys
from schemas.bus import BadEndpoint, Bus, BusError, ensure_hub

LOOK_S: Final = 0.25
ALONE_S: Final = 0.5
"""Without a link for this long: see that there is a hub."""
DEFAULT_OUT: Final = "sessions"


@click.command()
@click.option(
    "--out",
    default=DEFAULT_OUT,
    show_default=True,
    type=click.Path(path_type=Path, file_okay=False),
    help="Directory in which the session's own directory is made.",
)
@click.option("--connect", metavar="ENDPOINT", help="The fleet's bus, e.g. tcp/127.0.0.1:7447.")
@click.option("--fleet", default=keys.DEFAULT_FLEET, show_default=True, help="Name of the fleet.")
@click.option("--with-parent", is_flag=True, help="End when the process that started this ends.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object per line: when ready, and at the end.")
def record(out: Path, connect: str | None, fleet: str, *, with_parent: bool, as_json: bool) -> None:
    """Record everything of a fleet to MCAP until Ctrl-C; prints the session's directory once nothing can be missed."""
    from fleet.recording.recorder import AnotherRecorder, Recorder, RecordingFailed

    parent = os.getppid() if with_parent else None
    stop = threading.Event()
    _on_signals(stop)
    try:
        with Bus.open(connect, start_hub=True) as bus:
            recorder = Recorder(bus, fleet, out)
            session = recorder.start()
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
    _say(
        as_json,
        {"session": str(session), "state": "closed", "messages": outcome.messages, "bytes": outcome.bytes, **lost},
        f"{session}: {outcome.messages} messages, {outcome.bytes} bytes, "
        f"{_count(outcome.drops, 'dropped here')}, {_count(outcome.missed, 'missed on the bus')}",
    )


def _on_signals(stop: threading.Event) -> None:
    def ask_to_stop(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    signal.signal(signal.SIGINT, ask_to_stop)
    signal.signal(signal.SIGTERM, ask_to_stop)


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


def _count(lost: Mapping[str, int], what: str) -> str:
    if not lost:
        return f"none {what}"
    worst = max(lost, key=lambda key: lost[key])
    return f"{sum(lost.values())} {what} (most on {worst}: {lost[worst]})"
