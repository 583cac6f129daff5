"""`fleet demo`: runs a job with three simulated cars as real processes, records and checks it, and exports it to Rerun.

Checks compare what a gateway believes with the truth: the simulator publishes the true mode, motors and LED of a car.
"""

import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import click
from msgspec import Struct, field, to_builtins

from fleet.client.client import Fleet
from fleet.client.outcome import Outcome
from fleet.client.reading import Reading
from schemas import bus, keys, messages
from schemas.gen import fleet_v1_pb2 as pb
from schemas.process import signals
from schemas.process.children import OWN_GROUP, end, wait
from schemas.process.parent import parent_option
from schemas.suggestion import how_to_install
from schemas.words import Basis, LinkState, Mode, Motion, Motors, Platform, Rank, Verdict

DEFAULT_OUT: Final = Path("sessions")
DEMO_CARS: Final = {"red": Platform.ARDUINO, "green": Platform.ARDUINO, "blue": Platform.RASPBERRY_PI}
DEMO_PLAN: Final = """\
# Red follows the line, green keeps clear of walls, blue is driven by hand.
fixed:
  red: {mode: tracking}
  green: {mode: obstacle_avoidance}
"""
LED_COLORS: Final = {"red": (255, 0, 16), "green": (0, 255, 64), "blue": (0, 64, 255)}
# On a busy machine, a process takes 10 s to start, and a message takes 1 s to arrive.
CHECK_TIMEOUT_S: Final = 30.0
"""Timeout for a condition of a check."""
PROCESS_EXIT_TIMEOUT_S: Final = 30.0
"""Timeout for the exit of a process: twice the worst case of the longest stop sequence."""


class Check(Struct, frozen=True):
    """One line of the summary."""

    name: str
    ok: bool
    words: str


class Demo(Struct):
    """One run of the demo: its checks, and the messages that it received."""

    folder: Path
    endpoint: str
    say: Callable[[str], None]
    checks: list[Check] = field(default_factory=list)
    truth: dict[str, pb.Truth] = field(default_factory=dict)
    published: dict[str, set[int]] = field(default_factory=dict)
    """Sequence numbers that this process received, by key. The recording must contain them."""

    def check(self, name: str, words: str, *, ok: bool) -> None:
        """Store the result of a check, and print it."""
        self.checks.append(Check(name, ok, words))
        mark = click.style("ok  ", fg="green") if ok else click.style("FAIL", fg="red", bold=True)
        self.say(f"{mark} {name}: {words}")

    def on_sample(self, sample: bus.Sample) -> None:
        """Store what was published. Runs on a Zenoh thread."""
        key = keys.parse(sample.key)
        if key is None or key.car not in DEMO_CARS:
            return
        if key.topic == "sim/truth":
            truth = sample.message()
            assert isinstance(truth, pb.Truth)
            self.truth[key.car] = truth
        else:
            self.published.setdefault(sample.key, set()).add(sample.sequence)

    def wait_until(self, condition: Callable[[], object], seconds: float = CHECK_TIMEOUT_S) -> bool:
        """Wait until the condition holds. Return False after the timeout."""
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.02)
        return True

    def wait_for_truth(self, car: str, field_name: str, value: object) -> bool:
        """Wait until a field of the simulated car's truth has this value. Return False after the timeout."""
        return self.wait_until(lambda: getattr(self.truth[car], field_name) == value)


@click.command(epilog="\b\nexamples:\n  fleet demo\n  fleet demo --json --no-view")
@click.option(
    "--sessions",
    "out",
    type=click.Path(file_okay=False, path_type=Path),
    default=DEFAULT_OUT,
    show_default=True,
    metavar="DIR",
    help="Write the session to DIR.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object: checks, session, rrd.")
@click.option(
    "--view/--no-view", default=None, help="Open Rerun's viewer afterwards (default: ask, if there is a display)."
)
def demo(out: Path, *, as_json: bool, view: bool | None) -> None:
    """Run a job with three simulated cars of two platforms, and check it: modes, driving, LEDs, a cut link, a stop."""

    def say(text: str) -> None:
        click.echo(text, err=as_json)

    try:
        out.mkdir(parents=True, exist_ok=True)
        run = Demo(out.resolve(), _free_endpoint(), say)
        with signals.sigterm_interrupts():
            session, rrd = _run(run)
    except BrokenPipeError:  # nobody reads what we say, so another directory would not help
        raise
    except OSError as error:
        raise click.ClickException(f"No demo in {out}: {error.strerror}. Name another place with --sessions.") from None
    failed = [check for check in run.checks if not check.ok]
    if as_json:
        result = {
            "ok": not failed,
            "session": str(session),
            "rrd": None if rrd is None else str(rrd),
            "checks": [to_builtins(check) for check in run.checks],
        }
        click.echo(json.dumps(result))
    else:
        newest = "latest" if out == DEFAULT_OUT else shlex.quote(str(session))
        passed = f"{len(run.checks) - len(failed)} of {len(run.checks)} checks passed."
        click.echo(f"\n{passed} Look at it: fleet replay {newest}")
    if failed:
        raise SystemExit(1)
    if rrd is not None and (
        view or (view is None and not as_json and _can_view() and click.confirm("Open it in Rerun?"))
    ):
        subprocess.run([sys.executable, "-m", "fleet.cli", "replay", str(session)], check=False)


def _run(run: Demo) -> tuple[Path | None, Path | None]:
    began = time.monotonic()
    with ExitStack() as stack:
        _started(stack, _process(run, "hub", "schemas.bus.hub", "--endpoint", run.endpoint))
        if not run.wait_until(lambda: bus.accepts(run.endpoint)):
            raise click.ClickException(f"no hub came up at {run.endpoint}")
        recorder = _started(
            stack,
            _process(
                run,
                "recorder",
                "fleet.cli",
                "record",
                *("--connect", run.endpoint, "--sessions", str(run.folder), "--json", *parent_option()),
            ),
        )
        session = Path(_line(recorder, "recorder")["session"])
        client = stack.enter_context(Fleet(run.endpoint, sender="demo", kind=Rank.PERSON))
        watcher = stack.enter_context(bus.Bus.open(run.endpoint))
        watcher.subscribe(f"{keys.DEFAULT_FLEET}/**", run.on_sample)
        simulator, links = _simulator(run, stack, session)
        gateways = {car: _started(stack, _gateway(run, car, link)) for car, link in links.items()}
        _act(run, stack, client, simulator, session)
        run.say("ending the gateways, the simulated cars and the recorder")
        for process in gateways.values():
            process.send_signal(signal.SIGTERM)
        codes = {car: _ended(process) for car, process in gateways.items()}
        run.check("gateways end", _ends(codes), ok=set(codes.values()) == {0})
        simulator.terminate()
        _ended(simulator)
        recorder.send_signal(signal.SIGTERM)
        code = _ended(recorder)
        run.check(
            "recording closed",
            session.name if code == 0 else f"{session.name}, {_ends({'the recorder': code})}",
            ok=code == 0,
        )
    took = time.monotonic() - began
    recorded = _check_recording(run, session)
    rrd = _replay(run, session, recorded)
    run.say(f"the job took {took:.0f} s")
    return session, rrd


# ---------------------------------------------------------------- the job


def _act(run: Demo, stack: ExitStack, client: Fleet, simulator: "subprocess.Popen[str]", session: Path) -> None:
    run.say("three gateways bring their cars to a known state")
    ready = run.wait_until(
        lambda: _motors(client) == dict.fromkeys(DEMO_CARS, Motors.OFF) and run.truth.keys() == DEMO_CARS.keys()
    )
    run.check("cars ready", _listed({car: f"motors {state}" for car, state in _motors(client).items()}), ok=ready)
    if not ready:
        raise click.ClickException("the cars did not get ready: is the machine overloaded?")

    for car, (r, g, b) in LED_COLORS.items():
        outcome = client.car(car).led(r, g, b)
        color = f"#{r:02x}{g:02x}{b:02x}"
        seen = outcome.ok and run.wait_for_truth(car, "led", color)
        run.check(f"{car} LED", color if seen else f"should be {color}, is {run.truth[car].led}", ok=seen)

    readings: list[Reading] = []

    def all_measured() -> bool:
        readings[:] = client.get("*/sensor/range")
        return len(readings) == len(DEMO_CARS)

    seen = run.wait_until(all_measured)
    ranges = ", ".join(f"{reading.key} {reading.value.range_m:.2f} m" for reading in readings)
    run.check("sensors by key", ranges, ok=seen)

    run.say("the coordinator assigns modes")
    plan = session / "plan.yaml"
    plan.write_text(DEMO_PLAN, encoding="utf-8")
    coordinator = _started(
        stack,
        _process(
            run,
            "coordinator",
            "fleet.cli",
            "plan",
            *("run", str(plan), "--connect", run.endpoint, *parent_option()),
        ),
    )
    for car, mode in (("red", Mode.TRACKING), ("green", Mode.OBSTACLE_AVOIDANCE)):
        seen = run.wait_for_truth(car, "mode", mode)
        run.check(f"{car} mode", mode if seen else f"should be {mode}, is {run.truth[car].mode}", ok=seen)
    seen = run.wait_until(lambda: _state(client, "red", "mode").verdict == Verdict.CONFIRMED)
    run.check("red mode known", _state(client, "red", "mode").evidence, ok=seen)

    run.say("red's link is cut; meanwhile blue is driven by hand")
    _ask(simulator, {"car": "red", "fault": "link_drop"})
    start = (run.truth["blue"].x_m, run.truth["blue"].y_m)
    outcome = client.car("blue").drive(Motion.FORWARD, 1.0)
    moved = run.wait_until(lambda: (run.truth["blue"].x_m, run.truth["blue"].y_m) != start)
    stood = run.wait_until(lambda: run.truth["blue"].motor_left == 0 == run.truth["blue"].motor_right)
    run.check(
        "blue driven",
        "moved, then stopped by itself"
        if outcome.ok and moved and stood
        else f"{'moved' if moved else 'did not move'}, {'stopped' if stood else 'did not stop'}: {outcome}",
        ok=outcome.ok and moved and stood,
    )
    lost = run.wait_until(lambda: _state(client, "red", "link").state == LinkState.LOST)
    run.check(
        "red cut",
        f"link {_state(client, 'red', 'link').state}, motors {_state(client, 'red', 'safety').motors}",
        ok=lost,
    )
    # The link comes back now, not after a fixed time, because on a busy machine that time might pass before the loss is
    # noticed.
    _ask(simulator, {"car": "red", "fault": "link_drop", "for_s": 0})
    back = run.wait_until(
        lambda: (
            _state(client, "red", "mode").verdict == Verdict.CONFIRMED
            and _state(client, "red", "link").state == LinkState.ONLINE
            and run.truth["red"].mode == Mode.TRACKING
        )
    )
    run.check("red back", f"link {_state(client, 'red', 'link').state}, {run.truth['red'].mode} again", ok=back)

    run.say("a person stops all cars; the coordinator leaves them alone")
    outcomes = client.stop()
    run.check(
        "stop",
        f"sent to all three, the last result after {max(each.took_s for each in outcomes):.1f} s, shown by "
        f"{_shown(outcomes)}"
        if all(each.ok for each in outcomes)
        else ", ".join(str(each) for each in outcomes if not each.ok),
        ok=all(each.ok for each in outcomes),
    )
    off = run.wait_until(lambda: all(map(_at_rest, run.truth.values())))
    run.check(
        "all motors off",
        "as the simulator says" if off else _listed({car: truth.mode for car, truth in run.truth.items()}),
        ok=off,
    )
    moved = run.wait_until(lambda: not all(map(_at_rest, run.truth.values())), 1.5)
    holds = {car: _state(client, car, "safety").hold.by for car in DEMO_CARS}
    run.check(
        "hold",
        f"by {', '.join(sorted(set(holds.values())))}: {'a car moved again' if moved else 'no car moved again'}",
        ok=not moved and all(holds.values()),
    )
    coordinator.send_signal(signal.SIGTERM)
    code = _ended(coordinator)
    run.check("coordinator ends", _ends({"the coordinator": code}), ok=code == 0)


def _shown(outcomes: Sequence[Outcome]) -> str:
    """Return the cars whose own readings show that they stopped."""
    return ", ".join(each.car for each in outcomes if each.basis == Basis.SHOWN) or "none"


def _ends(codes: Mapping[str, int | None]) -> str:
    """Return how processes have ended, in words."""
    bad = {name: "did not end" if code is None else f"exit code {code}" for name, code in codes.items() if code != 0}
    return _listed(bad) if bad else "in order"


def _listed(values: Mapping[str, object]) -> str:
    return ", ".join(f"{name} {value}" for name, value in sorted(values.items()))


def _state(client: Fleet, car: str, name: str) -> Any:
    found = client.get(f"{car}/state/{name}")
    return found[0].value if found else messages.message_class(f"fleet.v1.{name.capitalize()}")()


def _at_rest(truth: pb.Truth) -> bool:
    return truth.mode == Mode.MANUAL and truth.motor_left == 0 == truth.motor_right


def _motors(client: Fleet) -> dict[str, str]:
    return {reading.key.split("/")[1]: reading.value.motors for reading in client.get("*/state/safety")}


# ---------------------------------------------------------------- the recording


def _check_recording(run: Demo, session: Path) -> Counter[str]:
    """Check with the mcap package's reader that the recording has every published message, without gaps."""
    from mcap.reader import make_reader

    recorded: dict[str, set[int]] = {}
    for path in sorted(session.glob("*.mcap")):
        with path.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages():
                recorded.setdefault(channel.topic, set()).add(message.sequence)
    missing = {key: sorted(numbers - recorded.get(key, set())) for key, numbers in run.published.items()}
    gaps = [key for key in run.published if recorded.get(key, set()) != set(range(1, max(recorded.get(key, {0})) + 1))]
    lost = {key: numbers for key, numbers in missing.items() if numbers}
    counted = Counter({key: len(numbers) for key, numbers in recorded.items()})
    words = (
        f"{counted.total()} messages on {len(counted)} keys, none missing"
        if not lost and not gaps
        else f"missing: {_listed(dict(lost))}; gaps: {', '.join(gaps)}"
    )
    run.check("recording complete", words, ok=not lost and not gaps and bool(run.published))
    return counted


def _replay(run: Demo, session: Path, recorded: Counter[str]) -> Path | None:
    """Export the recording to Rerun, and check that each key has the same number of messages."""
    if find_spec("rerun") is None:
        run.say(f"no check of what Rerun shows: {how_to_install('view')}")
        return None
    from fleet.replay.rerun.rrd_export import rows

    rrd = session / "session.rrd"
    command = [sys.executable, "-m", "fleet.cli", "replay", str(session), "--save", str(rrd)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0 or not rrd.exists():
        run.check("rrd made", (done.stderr or done.stdout).strip(), ok=False)
        return None
    shown = rows(rrd)
    differing = {key: (count, shown[key]) for key, count in recorded.items() if shown[key] != count}
    words = f"{shown.total()} messages read back with Rerun, as many as recorded"
    run.check(
        "rrd complete", words if not differing else f"recorded and shown differ: {_listed(differing)}", ok=not differing
    )
    return rrd


# ---------------------------------------------------------------- processes


@contextmanager
def _process(run: Demo, name: str, module: str, *arguments: str) -> "Iterator[subprocess.Popen[str]]":
    """Run a process. At the end of the block, end it and print its last lines if it failed."""
    environment = os.environ | {"FLEET_STATE_DIR": str(run.folder / ".state")}
    process = subprocess.Popen(
        [sys.executable, "-m", module, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        process_group=OWN_GROUP,
    )
    last_lines: deque[str] = deque(maxlen=3)
    assert process.stderr is not None
    # `extend` reads the pipe to its end, so that the process never blocks on it.
    reader = threading.Thread(target=last_lines.extend, args=(process.stderr,), name=f"log of {name}")
    reader.start()
    try:
        yield process
    finally:
        if not end(process, PROCESS_EXIT_TIMEOUT_S):
            run.check(f"{name} ends", f"it did not within {PROCESS_EXIT_TIMEOUT_S:g} s and was killed", ok=False)
        reader.join()
        for pipe in (process.stdin, process.stdout, process.stderr):
            assert pipe is not None
            pipe.close()
        if process.returncode not in (0, -signal.SIGTERM):
            run.say(f"{name} ended with {process.returncode}: {''.join(last_lines).strip()}")


def _started(stack: ExitStack, process: "AbstractContextManager[subprocess.Popen[str]]") -> "subprocess.Popen[str]":
    """Start a process that the stack ends.

    Delay signals until the stack has the process: an earlier signal could leave the process running.
    """
    with signals.held_back():
        return stack.enter_context(process)


def _simulator(run: Demo, stack: ExitStack, session: Path) -> "tuple[subprocess.Popen[str], dict[str, str]]":
    links = {"red": f"pty:{session / 'red.tty'}", "green": "pty", "blue": "tcp://127.0.0.1:0"}
    cars = [part for car, platform in DEMO_CARS.items() for part in ("--car", f"{car}:{platform}:{links[car]}")]
    where = ("--connect", run.endpoint, *parent_option())
    process = _started(stack, _process(run, "simulator", "gateway.cli", "sim", *cars, "--seed", "7", *where))
    lines = [_line(process, "simulator") for _ in DEMO_CARS]
    return process, {each["car"]: each["link"] for each in lines}


def _gateway(run: Demo, car: str, link: str) -> Any:
    options = ("--car", car, "--link", link, "--platform", DEMO_CARS[car], "--connect", run.endpoint, *parent_option())
    return _process(run, f"gateway of {car}", "gateway.cli", "run", *options)


def _line(process: "subprocess.Popen[str]", name: str) -> dict[str, Any]:
    """Return the next JSON line of a process."""
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        raise click.ClickException(f"the {name} ended before it was ready (exit code {_ended(process)})")
    answer: dict[str, Any] = json.loads(line)
    return answer


def _ended(process: "subprocess.Popen[str]") -> int | None:
    return wait(process, PROCESS_EXIT_TIMEOUT_S)


def _ask(process: "subprocess.Popen[str]", request: dict[str, object]) -> dict[str, Any]:
    assert process.stdin is not None
    process.stdin.write(json.dumps(request) + "\n")
    process.stdin.flush()
    return _line(process, "simulator")


def _free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _can_view() -> bool:
    from fleet.replay.rerun.viewer import has_display

    return sys.stdin.isatty() and has_display()
