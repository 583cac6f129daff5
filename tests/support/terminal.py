"""A person at a terminal: a process on a pseudo terminal, whose screen a test reads and to which it types."""

import os
import pty
import re
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

from tests.support.processes import PATIENCE_S, wait_for

_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class Terminal:
    """A program on one terminal for stdin, stdout and stderr. Without a program: `python -m MODULE`."""

    def __init__(
        self,
        *arguments: str,
        environment: Mapping[str, str],
        directory: Path,
        program: Sequence[str] = (sys.executable, "-m"),
    ) -> None:
        self._controller, device = pty.openpty()
        self.popen = subprocess.Popen(
            [*program, *arguments],
            stdin=device,
            stdout=device,
            stderr=device,
            env=os.environ | {"COLUMNS": "200", "TERM": "xterm", **environment},
            cwd=directory,
            start_new_session=True,
        )
        os.close(device)
        self._shown = bytearray()
        self._seen = 0
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    @property
    def shown(self) -> str:
        """Return all output until now, without colors and cursor moves."""
        return _ESCAPES.sub("", self._shown.decode(errors="replace")).replace("\r\n", "\n")

    def until(self, words: str) -> str:
        """Wait until these words appear after those of the last wait. Return the output up to them."""

        def there() -> bool:
            return words in self.shown[self._seen :] or (self.popen.poll() is not None and not self._reader.is_alive())

        wait_for(there, f"shows {words!r}", 2 * PATIENCE_S)
        begin = self._seen
        at = self.shown.find(words, begin)
        assert at >= 0, self.shown
        self._seen = at + len(words)
        return self.shown[begin : self._seen]

    def type(self, text: str) -> None:
        """Type a line."""
        os.write(self._controller, text.encode() + b"\n")

    def wait(self) -> int:
        """Wait for the end of the process. Return the exit code."""
        code = self.popen.wait(PATIENCE_S)
        self._reader.join(PATIENCE_S)
        return code

    def close(self) -> None:
        """End the process if it still runs."""
        if self.popen.poll() is None:
            self.popen.terminate()
        self.wait()
        os.close(self._controller)

    def _read(self) -> None:
        while True:
            try:
                data = os.read(self._controller, 4096)
            except OSError:  # the last process on the terminal has ended
                return
            if not data:
                return
            self._shown += data
