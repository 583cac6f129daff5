"""`fleet play`: publishes a session again."""

import sys
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from fleet.commands.car_names import car_option
from fleet.commands.command_group import connect_option
from fleet.commands.exit_code import cli_errors
from fleet.commands.options import from_option, to_option
from fleet.commands.params import Duration, Number, session_argument
from fleet.recording import time_spec
from fleet.recording.left_out import LeftOutCause
from fleet.recording.selection import Selection
from schemas import keys
from schemas.printable import printable, printable_lines
from schemas.process import signals

if TYPE_CHECKING:
    from fleet.recording.reading.session import Recorded, Session
    from fleet.recording.tools.summary import SessionSummary

PROGRESS_INTERVAL_S: Final = 0.5
_DAY_S: Final = 86_400.0
INITIAL_VALUES_NS: Final = 300_000_000_000
"""Time before the start that is searched for the latest values, such as a plan or a battery voltage."""


@click.command(
    epilog="""\b
examples:
  fleet play
  fleet play --as rehearsal --rate 4 --loop
  fleet play --car red --from=-60s
  fleet play latest --skip-gaps 5s # a gap in the recording lasts at most 5 s

Look at it with `fleet list --fleet fleet-replay`, or run your own program on it."""
)
@session_argument
@car_option
@from_option
@to_option
@click.option(
    "--as", "name", metavar="NAME", help="Name of the replayed fleet (default: the recorded name with -replay)."
)
@click.option("--rate", default=1.0, type=Number(float, 0.01, 1000.0), help="Play FACTOR times as fast.")
@click.option("--loop", is_flag=True, help="Repeat until Ctrl-C.")
@click.option("--offset", metavar="TIME", help="Start at this time. With --loop, only the first round starts there.")
@click.option(
    "--skip-gaps",
    "skip_gaps_s",
    type=Duration(_DAY_S),
    help="Maximum gap between messages, such as 5s. Longer gaps are shortened.",
)
@click.option(
    "--cars-only", is_flag=True, help="Leave out the messages of the coordinator, the recorder and the supervisor."
)
@connect_option()
def play(
    session: Path,
    cars: tuple[str, ...],
    start: str | None,
    end: str | None,
    *,
    name: str | None,
    rate: float,
    loop: bool,
    offset: str | None,
    skip_gaps_s: float | None,
    cars_only: bool,
    connect: str | None,
) -> None:
    """Publish a session again for your own programs, as a fleet with another name and with the original timing.

    No car moves, because a replayed fleet accepts no commands.
    """
    from fleet.commands.session_part import part_of
    from fleet.recording.reading.session import NoSession, Session
    from fleet.recording.tools.summary import of_session
    from fleet.replay.player.player import LOOP_PAUSE_NS, NameTaken, Player
    from fleet.replay.player.schedule import Schedule
    from schemas.bus import Bus

    stop = threading.Event()
    signals.calls(stop.set)
    with cli_errors():
        try:
            found = Session(session)
            part = part_of(found, start, end, cars)
            about = of_session(found)
            begin_ns = about.start_ns if part.start_ns is None else part.start_ns
            end_ns = about.end_ns if part.end_ns is None else part.end_ns
            first_ns = begin_ns if offset is None else _time("--offset", offset, begin_ns, end_ns)
            if not begin_ns <= first_ns < max(end_ns, begin_ns + 1):
                length = time_spec.words((end_ns - begin_ns) / 1e9)
                raise click.UsageError(f"--offset {offset} is outside the selected part, which is {length} long")
            gap_ns = None if skip_gaps_s is None else round(skip_gaps_s * 1e9)
            fleets = _fleets(found, about)
            name = keys.check_name(name or f"{fleets[0]}-replay", "fleet name (--as)")
            if name in fleets:
                raise click.UsageError(
                    f"--as {name} is the recorded fleet's own name. Choose another, such as --as {name[:25]}-replay, "
                    "so that nobody mistakes the replay for real cars."
                )
        except NoSession as error:
            raise click.ClickException(str(error)) from None
        if not any(keys.parse(key) for key in about.keys):
            raise click.ClickException(f"{session} has no messages of a fleet (no key FLEET/CAR/...)")
        expressions = _key_expressions(cars, cars_only=cars_only)
        there = cars or tuple(about.cars)
        words = f"fleet {name} is a replay of {found.name}: it accepts no commands"
        schedule = Schedule(rate, gap_ns)
        with Bus.open(connect, start_hub=True) as bus:
            if bus.identity:
                raise click.ClickException(
                    f"The rules of {bus.endpoint} let nobody publish for a car. Play the session on another bus: "
                    "`fleet play --connect tcp/127.0.0.1:7449`."
                )
            player = Player(bus, name, words, cars_only)
            try:
                player.begin(found.name, there)
            except NameTaken as error:
                raise click.UsageError(str(error)) from None
            click.echo(
                f"{found.name} as fleet {name} at {bus.endpoint}, {rate:g} times as fast: "
                f"{', '.join(map(printable, there)) or 'no car'}; Ctrl-C ends"
            )
            player.remember(found.messages(expressions, first_ns - INITIAL_VALUES_NS, first_ns))
            # Without --offset, do not begin at `first_ns`: if the clock went back, later messages have earlier times.
            from_ns = part.start_ns if offset is None else first_ns
            progress = _Progress((end_ns - begin_ns) / 1e9)
            origin_s = time.monotonic()
            while not stop.is_set():
                recorded = found.messages(expressions, from_ns, part.end_ns)
                player.play(_with_start_at(recorded, from_ns, schedule), schedule, origin_s, stop.is_set, progress)
                if not player.published and not stop.is_set():
                    why = "".join(f"; {line}" for line in player.left_out.words())
                    raise click.ClickException(f"{session} has no messages there that can be published again{why}")
                if not loop or stop.is_set():
                    break
                schedule.again(LOOP_PAUSE_NS)
                from_ns = part.start_ns
            progress.end()
    took_s = time.monotonic() - origin_s
    click.echo(f"{player.published} messages in {took_s:.1f} s")
    notes = {
        f"messages came over 0.25 s late: {rate:g} times as fast is too fast for this computer": player.late,
        "gaps were shortened": schedule.shortened,
    }
    for note, count in notes.items():
        if count:
            click.echo(f"{count} {note}", err=True)
    # Messages on keys that no selection matches never reached the player.
    everything = Selection(tuple(_key_expressions((), cars_only=False)))
    for key, count in about.keys.items():
        if not everything.has_key(key):
            player.left_out.add(key, LeftOutCause.COMMAND if "/@cmd/" in key else LeftOutCause.NO_FLEET, count)
    for line in player.left_out.words():
        click.echo(f"not published: {line}", err=True)
    if found.damage:
        click.echo(printable_lines(f"only the intact part was published: {found.damage_words}"), err=True)


def _with_start_at(recorded: Iterable["Recorded"], from_ns: int | None, schedule: Any) -> Iterator["Recorded"]:
    """Start the schedule at `from_ns`, so that the player also waits for the first message."""
    if from_ns is not None:
        schedule.due_s(from_ns)
    yield from recorded


def _time(option: str, text: str, start_ns: int, end_ns: int) -> int:
    try:
        return time_spec.at_ns(text, start_ns, end_ns, time.time())
    except ValueError as error:
        raise click.UsageError(f"{option}: {error}") from None


def _fleets(session: "Session", about: "SessionSummary") -> list[str]:
    """Return the recorded fleet's name, then those of other fleets in keys, or the default fleet if there is none."""
    described = [session.description.fleet] if session.description is not None and session.description.fleet else []
    of_keys = (key.fleet for key in map(keys.parse, about.keys) if key is not None)
    return list(dict.fromkeys([*described, *of_keys])) or [keys.DEFAULT_FLEET]


def _key_expressions(cars: tuple[str, ...], *, cars_only: bool) -> list[str]:
    services = (keys.COORDINATOR, keys.RECORDER, keys.SUPERVISOR)
    expressions = [f"*/{car}/**" for car in cars or ("*",)] + [f"*/{keys.SIMULATOR}/**"]
    return expressions if cars_only else [*expressions, *(f"*/{service}/**" for service in services)]


class _Progress:
    """The progress on one line of the terminal."""

    def __init__(self, length_s: float) -> None:
        self._length_s = length_s
        self._shown = sys.stderr.isatty()
        self._printed_at = 0.0
        self._start_ns: int | None = None

    def __call__(self, one: "Recorded") -> None:
        if not self._shown:
            return
        self._start_ns = one.recorded_ns if self._start_ns is None else min(self._start_ns, one.recorded_ns)
        now = time.monotonic()
        if now - self._printed_at > PROGRESS_INTERVAL_S:
            self._printed_at = now
            at_s = (one.recorded_ns - self._start_ns) / 1e9
            sys.stderr.write(f"\r{at_s:8.1f} s of {self._length_s:.1f} s ")
            sys.stderr.flush()

    def end(self) -> None:
        """Clear the line."""
        if self._shown:
            sys.stderr.write("\r" + " " * 40 + "\r")
