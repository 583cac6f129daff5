"""The control channel of `gateway sim`: one JSON object per line on stdin, one answer per line on stdout."""

import asyncio
import json
import os
import signal
import sys
import threading
from typing import Final

from msgspec import to_builtins

from gateway.sim.car_spec import BadSpec
from gateway.sim.endpoints import EndpointError
from gateway.sim.faults import fault_of, press_of
from gateway.sim.model.capture_car import CaptureCar
from gateway.sim.simulation import Simulation
from gateway.sim.world_commands import change_of
from schemas.process import stdio

MAX_COMMAND_BYTES: Final = 65536


def print_json(line: dict[str, object]) -> None:
    """Print one line of JSON to stdout. If the reader has gone or the disk is full, print nothing more."""
    try:
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
    except OSError as error:
        stdio.silence(sys.stdout)
        if not isinstance(error, BrokenPipeError):  # a closed pipe needs no message
            sys.stderr.write(
                f"gateway sim: stdout cannot be written ({error.strerror}). The cars run on without output.\n"
            )


async def serve_commands(simulation: Simulation) -> None:
    """Carry out the commands on stdin and answer each, until cancelled."""
    lines: asyncio.Queue[bytes] = asyncio.Queue()
    threading.Thread(target=_read_lines, args=(asyncio.get_running_loop(), lines), daemon=True).start()
    while True:
        line = await lines.get()
        if line.strip():
            print_json(await _answer(simulation, line))


def _read_lines(loop: asyncio.AbstractEventLoop, lines: "asyncio.Queue[bytes]") -> None:
    """Read stdin, which may be a pipe, a terminal, a file or closed. Its end does not end the simulator."""
    # This calls `os.read`: with the buffered stdin, this daemon thread would hold the lock of stdin, which breaks the
    # interpreter's shutdown.
    if hasattr(signal, "pthread_sigmask"):
        # Without this, the system stops a process in the background that reads its terminal.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTTIN})
    rest = b""
    while True:
        try:
            data = os.read(0, 4096)
        except OSError:
            return
        if not data:
            return
        *whole, rest = (rest + data).split(b"\n")
        rest = rest[-MAX_COMMAND_BYTES:]
        try:
            for line in whole:
                loop.call_soon_threadsafe(lines.put_nowait, line)
        except RuntimeError:  # the loop has ended
            return


async def _answer(simulation: Simulation, line: bytes) -> dict[str, object]:
    try:
        fields = json.loads(line)
        if isinstance(fields, dict) and "ask" in fields:
            return _asked(simulation, fields)
        if isinstance(fields, dict) and ("lamp" in fields or "thing" in fields):
            simulation.change(change_of(fields, simulation.world))
            return {"ok": True, **{word: fields[word] for word in ("lamp", "thing") if word in fields}}
        if isinstance(fields, dict) and "ir" in fields:
            press = press_of(fields)
            return {"ok": True, "ir": press.button.value, "obeyed": simulation.press(press)}
        fault = fault_of(fields)
        return {"ok": True, "fault": fault.kind.value, "cars": await simulation.inflict(fault)}
    except ValueError as error:  # BadSpec, or invalid JSON
        words = str(error) if isinstance(error, BadSpec) else f"not JSON: {error}"
    except RecursionError:
        words = "not allowed: the JSON is nested too deep"
    except EndpointError as error:
        words = str(error)
    return {"ok": False, "error": words}


def _asked(simulation: Simulation, fields: dict[str, object]) -> dict[str, object]:
    """Return the answer to a question. Raises BadSpec if it is wrong."""
    what = fields["ask"]
    if what not in ("truth", "world"):
        raise BadSpec(f"ask {what!r} is not allowed: use truth or world")
    for word in fields.keys() - {"ask", "car"}:
        raise BadSpec(f"field {word!r} is not allowed in ask: use car")
    if what == "truth":
        return _truth(simulation, fields.get("car"))
    return {"ok": True, **simulation.world_as_it_is()}


def _truth(simulation: Simulation, name: object) -> dict[str, object]:
    car = simulation.cars.get(name) if isinstance(name, str) else None
    if car is None:
        raise BadSpec(f"car {name!r} is not simulated here: use {', '.join(simulation.cars)}")
    truth, pose = car.truth, car.pose
    fields: dict[str, object]
    if truth is None or pose is None:
        capture = car.firmware
        assert isinstance(capture, CaptureCar)
        fields = {"sent_bytes": capture.sent_bytes, "ignored_bytes": capture.ignored_bytes, "rounds": capture.rounds}
    else:
        fields = {**to_builtins(truth), **pose._asdict()}
    return {"ok": True, "car": name, **fields, "lost_bytes": car.lost_bytes}
