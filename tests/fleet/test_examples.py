"""Runs the examples unchanged, as processes, against simulated cars. The cars show the effects."""

import ast
import json
import signal
from pathlib import Path

import pytest

from fleet import Fleet
from fleet.examples import EXAMPLES
from tests.fleet.conftest import Cars, asked
from tests.support.processes import LONG_S, driving, wait_for

PROGRAMS = EXAMPLES / "programs"
LINES = 30


def run(cars: Cars, name: str, *arguments: str) -> list[str]:
    """Run an example to its end. Return its output."""
    process = cars.start("-u", "-m", f"fleet.examples.programs.{name}", *arguments)
    assert process.wait() == 0, process.stderr
    return process.lines()


def code(notebook: Path) -> list[str]:
    """Return the code cells of a notebook."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


@pytest.mark.parametrize("path", sorted(PROGRAMS.glob("*.[pi]*")), ids=lambda path: path.name)
def test_each_is_under_thirty_lines(path: Path) -> None:
    text = "\n".join(code(path)) if path.suffix == ".ipynb" else path.read_text(encoding="utf-8")
    assert len(text.splitlines()) < LINES


def test_drive_one(cars: Cars) -> None:
    before = cars.sim.say({"car": "red", "ask": "truth"})
    assert run(cars, "drive_one", "red") == []
    after = cars.sim.say({"car": "red", "ask": "truth"})
    assert (before["x_m"], before["y_m"]) != (after["x_m"], after["y_m"])
    assert not driving(cars.sim, "red")


def test_drive_one_says_who_has_the_car(cars: Cars) -> None:
    with Fleet(cars.endpoint, sender="mia", kind="person") as mia, mia.car("red").lease():
        process = cars.start("-m", "fleet.examples.programs.drive_one", "red")
        assert process.wait() == 1
    assert "mia (person)" in process.stderr, process.stderr
    assert len(process.stderr.splitlines()) == 1


def test_read_all(cars: Cars) -> None:
    lines = run(cars, "read_all")
    assert lines[0] == "cars: blue, green, red"
    assert any(line.startswith("red: ") and " V, " in line for line in lines)
    assert len([line for line in lines if line.endswith((" m", "no echo"))]) == 20


def test_follow_the_leader(cars: Cars) -> None:
    with Fleet(cars.endpoint, sender="mia", kind="person") as mia:
        process = cars.start("-m", "fleet.examples.programs.follow_the_leader", "red", "blue")
        wait_for(lambda: cars.state("safety", "blue").HasField("lease"), "blue is the example's")
        asked(lambda: mia.car("red").drive("forward", LONG_S, wait=False)).check()
        wait_for(lambda: driving(cars.sim, "blue"), "blue does as red does")
        mia.car("red").drive("stop").check()
        wait_for(lambda: not driving(cars.sim, "blue"), "and stops with it")
        asked(lambda: mia.car("red").drive("forward", LONG_S, wait=False)).check()
        wait_for(lambda: driving(cars.sim, "blue"), "blue drives again")
        assert process.end(signal.SIGINT) == 0, process.stderr
        assert not driving(cars.sim, "blue")
        assert process.lines()[:3] == ["blue: forward", "blue: stop", "blue: forward"]
        mia.car("red").drive("stop").check()


def test_custom_policy(cars: Cars) -> None:
    """Only red can avoid obstacles. After a person's stop, the policy leaves red alone."""
    with Fleet(cars.endpoint, sender="mia", kind="person") as mia:
        process = cars.start("-m", "fleet.examples.programs.custom_policy")
        wait_for(lambda: cars.state("mode").asked == "obstacle_avoidance", "red avoids obstacles")
        mia.stop(["red"])
        assert process.wait() == 0, process.stderr
        lines = process.lines()
        assert lines.count("red: switching to mode obstacle_avoidance") == 1
        assert len([line for line in lines if line.startswith("red: refused: ") and "(mia" in line]) == 2
        # In the first round, only if this car has more room than red.
        assert len([line for line in lines if line.startswith("blue: refused: blue (raspberry_pi) has no mode")]) in (
            2,
            3,
        )
        assert cars.state("mode").asked == "manual"
        mia.car("red").resume().check()


def test_notebook(cars: Cars) -> None:
    """The cells run in order in one namespace, and each shows its last line, as in a notebook."""
    run_cells = (
        "import ast, json, sys\n"
        "space = {}\n"
        "for cell in json.load(sys.stdin):\n"
        "    *first, last = ast.parse(cell).body\n"
        "    exec(compile(ast.Module(first, []), 'cell', 'exec'), space)\n"
        "    print(json.dumps(repr(eval(compile(ast.Expression(last.value), 'cell', 'eval'), space))))\n"
    )
    cells = code(PROGRAMS / "notebook.ipynb")
    process = cars.start("-c", run_cells)
    assert process.popen.stdin is not None
    process.popen.stdin.write(json.dumps(cells))
    process.popen.stdin.close()
    assert process.wait() == 0, process.stderr
    there, ranges, past, drove, motors, stopped = (json.loads(line) for line in process.lines())
    assert ast.literal_eval(there) == ["blue", "green", "red"]
    assert "fleet/red/sensor/range" in ast.literal_eval(ranges)
    assert len(ast.literal_eval(past)) > 3
    assert "ok=True" in drove
    assert "basis='sent'" in drove or "basis='shown'" in drove
    assert motors == "'off'"
    assert stopped.count("ok=True, phase='sent'") == 2, "a Raspberry Pi can show nothing"
    assert stopped.count("ok=True, phase='complete'") == 1
    with Fleet(cars.endpoint, sender="mia", kind="person") as mia:
        assert all(outcome.ok for outcome in mia.resume(list(cars.gateways)))
