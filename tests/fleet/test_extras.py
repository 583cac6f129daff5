"""Without an extra, only its own commands fail, with a message that names the install command."""

import json
import subprocess
import sys
from typing import Any

import pytest
from mcap.writer import Writer

from schemas.gen import fleet_v1_pb2 as pb
from tests.fleet.replay.make_session import Made

VIEW = (1, "pip install 'zenoh-car-fleet[view]'")
CONSOLE = (1, "pip install 'zenoh-car-fleet[console]'")
FOXGLOVE = (1, "pip install 'zenoh-car-fleet[foxglove]'")
MQTT = (1, "pip install 'zenoh-car-fleet[mqtt]'")
METRICS = (1, "pip install 'zenoh-car-fleet[metrics]'")
ANALYSIS = (1, "pip install 'zenoh-car-fleet[analysis]'")
WORKS = (0, "")
RUN = """
import json, sys
import tests.support.without_extras
from tests.support.in_process import fleet
for words in json.load(sys.stdin):
    done = fleet(*words)
    print(json.dumps([done.returncode, done.stdout, done.stderr]))
"""


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Run every command in one process that cannot import the packages of the extras."""
    folder = tmp_path_factory.mktemp("extras")
    made = Made(folder / "one.mcap", Writer)
    made.put("fleet/red/state/mode", pb.Mode(asked="manual"), 1.0)
    made.close()
    lines = [command.replace("SESSION", str(folder / "one.mcap")).replace("OUT", str(folder)) for command in EXPECTED]
    done = subprocess.run(
        [sys.executable, "-c", RUN],
        input=json.dumps([line.split() for line in lines]),
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    return dict(zip(EXPECTED, map(json.loads, done.stdout.splitlines()), strict=True))


EXPECTED = {
    "replay SESSION": VIEW,
    "replay SESSION --save OUT/one.rrd": VIEW,
    "view": VIEW,
    "console": CONSOLE,
    "exporter": METRICS,
    "foxglove": FOXGLOVE,
    "mqtt": MQTT,
    "up --sim 1 --console": CONSOLE,
    "view --save OUT/live.rrd": VIEW,
    "sessions export SESSION --parquet OUT/parquet": ANALYSIS,
    "sessions export SESSION --csv OUT/csv": WORKS,
    "sessions info SESSION": WORKS,
    "sessions cut SESSION --out OUT/cut": WORKS,
    "sessions recover SESSION --out OUT/whole": WORKS,
    "sessions verify SESSION": WORKS,
    "example list": WORKS,
}


@pytest.mark.parametrize("command", EXPECTED)
def test_command_works_or_says_what_to_type(command: str, outcomes: dict[str, Any]) -> None:
    code, said = EXPECTED[command]
    returncode, stdout, stderr = outcomes[command]
    assert returncode == code, (stdout, stderr)
    if code:
        assert (stdout, stderr.count("\n")) == ("", 1)
        assert stderr.startswith("fleet: ")
        assert said in stderr
