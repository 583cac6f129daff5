"""The command `fleet doctor` on real gateways and on a real recording."""

import json
from pathlib import Path
from subprocess import CompletedProcess

from tests.fleet.conftest import Cars
from tests.fleet.recording.damaged import written
from tests.fleet.recording.tools.test_sessions_command import describe
from tests.support import in_process


def doctor(cars: Cars, *arguments: str) -> CompletedProcess[str]:
    return in_process.fleet("doctor", *arguments, "--connect", cars.endpoint, cwd=cars.directory)


def test_a_car_has_its_likely_cause_and_ten_lines(cars: Cars) -> None:
    well = doctor(cars, "green")
    assert (well.returncode, well.stdout.splitlines()[0]) == (0, "green: Nothing odd was found."), well.stdout
    cars.ask("stop", "red", sender="mia", kind="person")
    cars.ready()
    assert cars.ask("drive", "red", sender="plan", kind="coordinator", motion="forward")["reason"] == "held"
    held = doctor(cars, "red")
    lines = held.stdout.splitlines()
    assert held.returncode == 1
    assert lines[0] == (
        "red: On hold: mia stopped it. No plan moves it until someone resumes it. Type: fleet resume red"
    )
    assert len(lines) <= 10
    assert any(line.startswith("  refused") and "[held]" in line for line in lines), held.stdout
    every = doctor(cars)
    assert [line.partition(":")[0] for line in every.stdout.splitlines()] == ["blue", "green", "red"]
    told = json.loads(doctor(cars, "red", "--json").stdout)
    assert [each["code"] for each in told["findings"]] == ["held"]
    assert "frames in" in told["facts"]["link"]
    cars.ask("resume", "red", sender="mia", kind="person")
    unknown = doctor(cars, "rde")
    assert (unknown.returncode, unknown.stderr) == (1, 'fleet: No car or session "rde". Did you mean red?\n')


def test_a_damaged_session_has_its_findings(tmp_path: Path) -> None:
    session = tmp_path / "sessions" / "20260921T141320Z-fleet"
    session.mkdir(parents=True)
    data = written(session / "0001.mcap").data
    describe(session, closed=True)
    well = in_process.fleet("doctor", "latest", cwd=tmp_path)
    assert well.returncode == 0, well.stdout
    (session / "0001.mcap").write_bytes(data[: len(data) // 2])
    done = in_process.fleet("doctor", "latest", cwd=tmp_path)
    assert done.returncode == 1
    assert done.stdout.splitlines()[0].startswith(f"{session.name}: Damaged: 0001.mcap ")
    assert f"Type: fleet sessions recover {session.name}" in done.stdout
    told = json.loads(in_process.fleet("doctor", session, "--json", cwd=tmp_path).stdout)
    assert "damage" in [each["code"] for each in told["findings"]]
