"""The live table of `fleet up` on a terminal: a row for each car, events above. Only this module imports rich."""

import asyncio
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, Self

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table as Grid
from rich.text import Text

from fleet.client.claims import describe_age, describe_bars
from fleet.column_widths import fit_columns
from fleet.supervisor.car_status import CarStatus
from schemas.keys import name_of
from schemas.local_time import clock
from schemas.rights import binding_pause
from schemas.words import BatteryLevel, LinkState, RunState, Verdict

if TYPE_CHECKING:
    from fleet.supervisor.supervisor import Supervisor, SupervisorEvent

DRAW_INTERVAL_S: Final = 0.25
DRAW_IDLE_FACTOR: Final = 10.0
"""Minimum pause between two drawings, as a multiple of the time of one. A hundred rows take 50 ms."""
_LINK: Final[dict[str, str]] = {
    LinkState.ONLINE: "green",
    LinkState.QUIET: "green",
    LinkState.STALE: "yellow",
    LinkState.LOST: "red",
}
_VERDICT: Final[dict[str, str]] = {Verdict.CONFIRMED: "green", Verdict.CONTRADICTED: "red"}
_EVENT: Final = "last event"
"""The column that gets the remaining width."""
_TABLE_COLUMNS: Final = ("car", "link", "mode", "motion", "motors", "held, driven by", "battery", "Hz", _EVENT)
_OPTIONAL_COLUMNS: Final = ("Hz", _EVENT, "motion", "motors")
"""Columns that a narrow terminal leaves out, in this order."""
_MIN_EVENT_WIDTH: Final = 16


class Table:
    """The table of one supervisor. Use it with `with`."""

    def __init__(self, supervisor: "Supervisor", console: Console | None = None) -> None:
        self._supervisor = supervisor
        self._console = console or Console()
        self._live = Live(console=self._console, auto_refresh=False, transient=False)
        self._broken = False

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._safely(lambda: self._live.update(self.rendered(), refresh=True))
        self._safely(self._live.stop)

    def on_event(self, event: "SupervisorEvent") -> None:
        """Print an event above the table if it is about a process, an old stop, or the start or end of the fleet."""
        if event.what in ("process", "hold", "end", "ready", "missing"):
            name = "" if event.what in ("ready", "missing") else f"{event.name}: "
            line = Text(f"{clock(time.time())} {name}{event.words}")
            self._safely(lambda: self._console.print(line))

    async def draw(self) -> None:
        """Redraw the table until cancelled."""
        while True:
            began = time.monotonic()
            self._safely(lambda: self._live.update(self.rendered(), refresh=True))
            await asyncio.sleep(max(DRAW_INTERVAL_S, DRAW_IDLE_FACTOR * (time.monotonic() - began)))

    def rendered(self) -> Group:
        """Return the table, with the states of the services below it."""
        grid = Grid(box=None, pad_edge=False, header_style="bold", expand=True)
        rows, now = [], time.monotonic()
        colors = self._supervisor.colors
        for name, status in self._supervisor.rows.items():
            process = self._supervisor.processes.get(name)
            running = process is not None and process.status.state is RunState.RUNNING
            state = "" if running else RunState.STARTING if process is None else str(process.status.state)
            rows.append(dict(zip(_TABLE_COLUMNS, _cells(status, state, colors.get(name, ""), now), strict=True)))
        widths = {each: max([len(each), *(row[each].cell_len for row in rows)]) for each in _TABLE_COLUMNS}
        widths[_EVENT] = _MIN_EVENT_WIDTH
        widths = fit_columns(widths, self._console.width, _OPTIONAL_COLUMNS)
        for column, width in widths.items():
            fixed = None if column == _EVENT else width
            ratio = 1 if column == _EVENT else None
            grid.add_column(column, no_wrap=True, overflow="ellipsis", width=fixed, ratio=ratio)
        for row in rows:
            grid.add_row(*(row[column] for column in widths))
        services = [
            Text.assemble(
                each.name, " ", (str(each.status.state), "green" if each.status.state is RunState.RUNNING else "yellow")
            )
            for each in self._supervisor.processes
            if each.name.startswith("@")
        ]
        return Group(grid, Text("  ").join([*services, Text(f"logs in {self._supervisor.processes.directory}", "dim")]))

    def _safely(self, write: Callable[[], object]) -> None:
        """Write unless the terminal was closed. A closed terminal must not prevent the shutdown."""
        if self._broken:
            return
        try:
            write()
        except OSError:
            self._broken = True


def _bars(safety: Any) -> str:
    """Return what keeps the car from driving. Unlike that of `fleet list`, this column also has who drives."""
    hold = f"hold {name_of(safety.hold.by)}" if safety.HasField("hold") else ""
    paused_by = binding_pause(safety.pauses).by if safety.pauses else ""
    return describe_bars([each.id for each in safety.estops], hold, paused_by, safety.loan.to)


def _cells(row: CarStatus, process: str, color: str, now: float) -> list[Text]:
    """Return the cells of a row. `now` is the time by the clock of the row's messages."""
    state, safety, battery = row.state, row.state.newest("state/safety"), row.state.newest("sensor/battery")
    claims = state.claims(now)
    link = process if process or not state.link.state else state.link.state
    old = f" ({describe_age(state.age_s('state/link', now))} old)" if not process and claims.link.is_stale else ""
    held = "" if safety is None else _bars(safety)
    volts = "" if battery is None else f"{battery.voltage_v:.2f} V"
    if state.is_stale("sensor/battery", now) and battery is not None:
        volts += f", {describe_age(state.age_s('sensor/battery', now))} old"
    is_low = battery is not None and battery.level != BatteryLevel.OK
    rate = "" if row.rate_hz is None else f"{row.rate_hz:.1f}"
    return [
        Text.assemble(("● " if color else "", color), (row.car, "bold")),
        Text(f"{link}{old}", "yellow" if old else _LINK.get(link, "yellow")),
        Text.assemble(state.mode.asked, " ", (state.mode.verdict, _VERDICT.get(state.mode.verdict, ""))),
        Text(state.motion.motion),
        Text(claims.motors.short if state.safety.motors else ""),
        Text(held or name_of(state.safety.lease.holder), "red" if held else ""),
        Text(f"{volts} {battery.level}" if is_low else volts, "red" if is_low else ""),
        Text(rate, justify="right"),
        Text(row.event, overflow="ellipsis", no_wrap=True),
    ]
