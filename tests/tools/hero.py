"""The README's animation and `fleet up` as SVG: `python -m tests.tools.hero DIRECTORY [SESSION]`.

Without SESSION, the tool records a session (about a minute): `fleet up --sim 3` with a plan, a stop and a resume of a
car. `hero.webp` has the simulated world from above, the commands, the plan's roles, and the table of `fleet up`.
`up.svg` has only the table. The cars come from `sim/truth`, walls and line from `@sim/world`. The code of `fleet up`
draws the table from the same messages.
"""

import io
import math
import os
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import matplotlib as mpl
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console
from rich.terminal_theme import MONOKAI

import fleet.examples
from fleet import Reading, Session
from fleet.replay.state_colors import rgb
from fleet.supervisor.car_status import CarStatus
from fleet.supervisor.status_table import Table
from schemas.colors import car_color, hex_color
from schemas.words import RunState
from tests.support.ports import free_endpoint

WIDTH: Final = 960
COLUMNS: Final = 102
FONT_SIZE: Final = 15
LINE_HEIGHT: Final = 22
MARGIN: Final = 14
WORLD_HEIGHT: Final = 356
TERMINAL_ROWS: Final = 5
FRAMES_PER_S: Final = 10
LENGTH_S: Final = 9.5
TRAIL_S: Final = 8.0
BEFORE_S: Final = 12.0
"""Time shown before the first command."""
AFTER_S: Final = 4.5
"""Time shown after the last command."""
DRIVE_S: Final = 26.0
HOLD_S: Final = 9.0
BACKGROUND: Final = (250, 250, 248)
GROUND: Final = (255, 255, 255)
WALL: Final = (60, 64, 72)
TAPE: Final = (40, 40, 40)
INK: Final = (40, 44, 52)
DIM: Final = (120, 124, 132)
TERMINAL: Final = tuple(MONOKAI.background_color)
PLAN: Final = ("roles:", "  patrol: {mode: obstacle_avoidance, count: 2}", "  guide:  {mode: tracking}")
COMMANDS: Final = ("stop", "resume")


@dataclass(slots=True)
class State:
    """The published state at a moment."""

    rows: dict[str, CarStatus] = field(default_factory=dict)
    services: dict[str, str] = field(default_factory=dict)
    truths: dict[str, Any] = field(default_factory=dict)
    trails: dict[str, deque[tuple[float, float, float]]] = field(default_factory=dict)
    world: Any = None
    commands: list[str] = field(default_factory=list)
    decisions: dict[str, str] = field(default_factory=dict)

    def take(self, reading: Reading, at_s: float) -> None:
        topic = reading.key.split("/", 2)[2]
        value = reading.value
        if topic == "sim/truth":
            self.truths[reading.car] = value
            self.trails.setdefault(reading.car, deque()).append((at_s, value.x_m, value.y_m))
        elif topic == "world":
            self.world = value
        elif reading.key.endswith("@supervisor/status"):
            self.services = {each.name: RunState(each.state) for each in value.processes if each.name.startswith("@")}
        elif reading.key.endswith("@coordinator/decision"):
            if value.kind in ("role", "alone"):
                self.decisions[value.subject] = f"{value.subject:<7}{value.role or '-':<9}{value.decided}"
        elif not reading.car.startswith("@") and reading.car:
            self.rows.setdefault(reading.car, CarStatus(reading.car)).take(topic, value, at_s)
            if topic == "event/command" and value.verb in COMMANDS and (value.phase, value.kind) == ("asked", "person"):
                self.commands.append(f"$ fleet {value.verb} {reading.car}")

    def table(self) -> Any:
        """Return the table of `fleet up`, drawn by its own code."""
        processes = _Processes(
            [SimpleNamespace(name=name, status=SimpleNamespace(state=state)) for name, state in self.services.items()],
            "~/.local/state",
        )
        rows = dict(sorted(self.rows.items()))
        colors = {car: hex_color(car_color(car, 0)) for car in rows}
        supervisor: Any = SimpleNamespace(rows=rows, processes=processes, colors=colors)
        return Table(supervisor, Console(file=io.StringIO(), width=COLUMNS)).rendered()


class _Processes(list[Any]):
    def __init__(self, services: list[Any], directory: str) -> None:
        super().__init__(services)
        self.directory = directory

    def get(self, name: str) -> Any:
        return SimpleNamespace(name=name, status=SimpleNamespace(state=RunState.RUNNING))


def states(session: Session, count: int) -> Iterator[State]:
    """Yield the state at `count` moments, from BEFORE_S before the first command to AFTER_S after the last one."""
    readings = sorted(session.messages(decode=True), key=lambda reading: reading.time)
    seconds = [reading.time.timestamp() for reading in readings]
    asked = [
        reading.time.timestamp()
        for reading in readings
        if reading.key.endswith("event/command") and reading["verb"] in COMMANDS and reading["kind"] == "person"
    ]
    start, end = asked[0] - BEFORE_S, asked[-1] + AFTER_S
    state, number = State(), 0
    for frame in range(count):
        at_s = start + (end - start) * frame / (count - 1)
        while number < len(readings) and seconds[number] <= at_s:
            state.take(readings[number], seconds[number])
            number += 1
        for trail in state.trails.values():
            while trail and trail[0][0] < at_s - TRAIL_S:
                trail.popleft()
        yield state


class Painter:
    """Draws the frames of the animation."""

    def __init__(self) -> None:
        fonts = Path(mpl.get_data_path()) / "fonts" / "ttf"
        self._mono = ImageFont.truetype(fonts / "DejaVuSansMono.ttf", FONT_SIZE)
        self._bold = ImageFont.truetype(fonts / "DejaVuSansMono-Bold.ttf", FONT_SIZE)
        self._advance = self._mono.getlength("M")
        self._height = WORLD_HEIGHT + TERMINAL_ROWS * LINE_HEIGHT + 3 * MARGIN

    def frame(self, state: State) -> Image.Image:
        image = Image.new("RGB", (WIDTH, self._height), BACKGROUND)
        draw = ImageDraw.Draw(image)
        right = self._world(image, state)
        left = right + 2 * MARGIN
        draw.text((left, MARGIN), "plan.yaml", DIM, self._bold)
        for number, line in enumerate(PLAN, 1):
            draw.text((left, MARGIN + number * LINE_HEIGHT), line, INK, self._mono)
        top = MARGIN + 5 * LINE_HEIGHT
        draw.text((left, top), "what you type", DIM, self._bold)
        for number, line in enumerate(["$ fleet up --sim 3 --plan plan.yaml", *state.commands], 1):
            draw.text((left, top + number * LINE_HEIGHT), line, INK, self._mono)
        top += 5 * LINE_HEIGHT
        draw.text((left, top), "what the plan decides", DIM, self._bold)
        for number, (car, line) in enumerate(sorted(state.decisions.items()), 1):
            draw.text((left, top + number * LINE_HEIGHT), line, _mixed(car_color(car, 0), 0.8, INK), self._bold)
        self._terminal(draw, state, WORLD_HEIGHT + 2 * MARGIN)
        return image

    def _world(self, image: Image.Image, state: State) -> int:
        """Draw the world from above at twice the size. Return its right edge."""
        ends = [end for wall in state.world.walls for end in (wall.begin, wall.end)]
        low_x, high_x = min(end.x_m for end in ends), max(end.x_m for end in ends)
        low_y, high_y = min(end.y_m for end in ends), max(end.y_m for end in ends)
        scale = 2 * (WORLD_HEIGHT - 8) / (high_y - low_y)
        size = (round((high_x - low_x) * scale) + 16, 2 * WORLD_HEIGHT)

        def place(x: float, y: float) -> tuple[float, float]:
            return (x - low_x) * scale + 8, (high_y - y) * scale + 8

        canvas = Image.new("RGB", size, GROUND)
        draw = ImageDraw.Draw(canvas)
        line = [place(point.x_m, point.y_m) for point in state.world.line]
        draw.line([*line, line[0]], TAPE, 8, joint="curve")
        for wall in state.world.walls:
            draw.line([place(wall.begin.x_m, wall.begin.y_m), place(wall.end.x_m, wall.end.y_m)], WALL, 8)
        for car, trail in state.trails.items():
            points = [place(x, y) for _, x, y in trail]
            for number, (one, other) in enumerate(pairwise(points)):
                share = (number + 1) / len(points)
                draw.line([one, other], _mixed(car_color(car, 0), share * 0.8), 6)
        for car, truth in state.truths.items():
            self._car(draw, place(truth.x_m, truth.y_m), truth, car_color(car, 0), 0.13 * scale)
        small = canvas.resize((size[0] // 2, size[1] // 2), Image.Resampling.LANCZOS)
        image.paste(small, (MARGIN, MARGIN))
        return MARGIN + small.width

    def _car(
        self, draw: ImageDraw.ImageDraw, at: tuple[float, float], truth: Any, tint: tuple[int, ...], radius: float
    ) -> None:
        corners = []
        for ahead, aside in ((1.15, 0.0), (-0.8, 0.75), (-0.8, -0.75)):
            heading = truth.heading_rad
            x = ahead * math.cos(heading) - aside * math.sin(heading)
            y = ahead * math.sin(heading) + aside * math.cos(heading)
            corners.append((at[0] + radius * x, at[1] - radius * y))
        draw.ellipse([at[0] - radius, at[1] - radius, at[0] + radius, at[1] + radius], _mixed(tint, 0.35), tint, 5)
        draw.polygon(corners, tint)
        if truth.led != "off" and (led := rgb(truth.led)):
            draw.ellipse([at[0] - 9, at[1] - 9, at[0] + 9, at[1] + 9], led, (255, 255, 255), 3)

    def _terminal(self, draw: ImageDraw.ImageDraw, state: State, top: int) -> None:
        draw.rectangle([0, top, WIDTH, self._height], TERMINAL)
        console = Console(file=io.StringIO(), width=COLUMNS, color_system="truecolor", force_terminal=True)
        for number, segments in enumerate(console.render_lines(state.table(), pad=False)):
            at = 0
            for text, style, _ in segments:
                tint: Any = MONOKAI.foreground_color
                if style is not None and style.color is not None:
                    tint = style.color.get_truecolor(MONOKAI)
                if style is not None and style.dim:
                    tint = _mixed(tint, 0.6, TERMINAL)
                font = self._bold if style is not None and style.bold else self._mono
                place = (MARGIN + at * self._advance, top + MARGIN // 2 + number * LINE_HEIGHT)
                draw.text(place, text, tuple(tint), font)
                at += len(text)


def _mixed(tint: tuple[int, ...], share: float, ground: tuple[int, ...] = GROUND) -> tuple[int, ...]:
    return tuple(round(one * share + other * (1 - share)) for one, other in zip(tint, ground, strict=True))


def record(directory: Path) -> Path:
    """Record a session below a directory, and return its path."""
    plan = Path(fleet.examples.__file__).parent / "plans" / "2-line-guide.yaml"
    environment = os.environ | {
        "FLEET_ENDPOINT": free_endpoint(),
        "FLEET_STATE_DIR": str(directory / "state"),
        "LOGNAME": "mia",
    }

    def run(*words: str) -> None:
        subprocess.run([sys.executable, "-m", "fleet.cli", *words], env=environment, check=True)

    run("up", "--sim", "3", "--plan", str(plan), "--sessions", str(directory / "sessions"), "--detach")
    try:
        time.sleep(DRIVE_S)
        run("stop", "red")
        time.sleep(HOLD_S)
        run("resume", "red")
        time.sleep(HOLD_S)
    finally:
        run("down")
    return max((directory / "sessions").iterdir())


def make(folder: Path, session: Path) -> None:
    """Write both pictures."""
    painter = Painter()
    frames = []
    state = State()
    for state in states(Session(session), round(LENGTH_S * FRAMES_PER_S)):
        frames.append(painter.frame(state))
    folder.mkdir(parents=True, exist_ok=True)
    frames[0].save(
        folder / "hero.webp",
        save_all=True,
        append_images=frames[1:],
        duration=1000 // FRAMES_PER_S,
        loop=0,
        quality=72,
        method=4,
    )
    console = Console(file=io.StringIO(), width=COLUMNS, record=True, force_terminal=True)
    console.print(state.table())
    console.save_svg(str(folder / "up.svg"), title="fleet up --sim 3 --plan plan.yaml", unique_id="up")


if __name__ == "__main__":
    _, out, *given = sys.argv
    make(Path(out), Path(given[0]) if given else record(Path(".tmp/pictures")))
