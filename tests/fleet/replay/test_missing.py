"""A command whose package is not installed says what to type."""

import subprocess
import sys
from pathlib import Path

import pytest
from mcap.writer import Writer

from schemas.gen import fleet_v1_pb2 as pb
from tests.fleet.replay.make_session import Made

WITHOUT = "import sys; sys.modules[sys.argv.pop(1)] = None; from fleet.cli import main; main()"


@pytest.mark.parametrize(
    ("module", "arguments", "told"),
    [
        ("rerun", "replay SESSION --save OUT", "rerun-sdk is not installed, and this command needs it: pip install 'r"),
        ("rerun", "view --save OUT", "rerun-sdk is not installed, and this command needs it: pip install 'rerun-sdk=="),
        ("pyarrow", "replay SESSION --save OUT", "pyarrow is not installed, and this command needs it: pip install 'p"),
    ],
)
def test_a_missing_package_is_told_in_a_line(module: str, arguments: str, told: str, tmp_path: Path) -> None:
    session = tmp_path / "one.mcap"
    made = Made(session, Writer)
    made.put("fleet/red/state/mode", pb.Mode(asked="manual"), 1.0)
    made.close()
    paths = {"SESSION": str(session), "OUT": str(tmp_path / "out.rrd")}
    words = [paths.get(word, word) for word in arguments.split()]
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT, module, *words], capture_output=True, text=True, check=False, timeout=60
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith(f"fleet: {told}"), done.stderr
    assert done.stderr.count("\n") == 1
