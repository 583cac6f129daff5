"""Tests that pytest collects each soak. `make soak` runs too seldom to find a broken import."""

import subprocess
import sys
from pathlib import Path

SOAK = Path(__file__).parent
ROOT = SOAK.parents[1]
MARK = "pytest.mark." + "soak"


def test_each_soak_is_collected() -> None:
    # pytest gets only the files with the mark: collecting all others takes half a minute on a busy machine.
    marked = sorted(path for path in (ROOT / "tests").rglob("test_*.py") if MARK in path.read_text())
    words: list[str | Path] = [*marked, "-m", "soak", "--collect-only", "-q", "-p", "no:cacheprovider"]
    listed = subprocess.run(
        [sys.executable, "-m", "pytest", *words], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert listed.returncode == 0, listed.stdout + listed.stderr
    collected = {ROOT / line.partition("::")[0] for line in listed.stdout.splitlines() if "::" in line}
    assert collected >= set(marked)
    assert {*SOAK.glob("test_*.py")} - {Path(__file__)} <= collected, "a file in tests/soak has no soak"
