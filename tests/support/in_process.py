"""Runs `fleet` in the process of the test, because the start of a process takes half a second of CPU time."""

import contextlib
import io
import subprocess
import sys
from pathlib import Path
from unittest.mock import patch

from fleet.cli import main
from tests.support.message_length import too_long


def fleet(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run the command. Return its exit code, stdout and stderr. Raise an error that would print a traceback."""
    words = ["fleet", *map(str, arguments)]
    out, err = io.StringIO(), io.StringIO()
    with (
        contextlib.chdir(cwd or Path.cwd()),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        patch.object(sys, "argv", words),
    ):
        try:
            main()
        except SystemExit as ended:
            assert too_long(err.getvalue()) == [], words
            return subprocess.CompletedProcess(words, int(ended.code or 0), out.getvalue(), err.getvalue())
    raise AssertionError("it ends without an exit code")
