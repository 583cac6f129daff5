"""Log lines as JSON, for gateways and `fleet`, if FLEET_LOG is `json`. All lines about one command have the same id.

Without the variable each process logs lines for a person. With it, each log line on stderr is one JSON object with
`time`, `level`, `process`, `pid` and `message`. The hub and `gateway sim` write text in any case, and so does a gateway
that does not understand its arguments. A line about a command also has its `command_id`, `verb` and `phase`.
The client (a command line, the console, the coordinator, a program) makes the id and sends it in the command's message,
so the gateway logs the same id. The recording has it too, in `event/command` and `frame/tx`.

A client logs each command that it sent and how it ended. A gateway logs one line for each record of `event/command`.
"""

import atexit
import io
import json
import logging
import os
import sys
from datetime import UTC, datetime
from typing import Any, Final

LOG_VARIABLE: Final = "FLEET_LOG"
JSON_FORMAT: Final = "json"
COMMANDS: Final = "fleet.commands"
"""Name of the logger of lines about commands. Without JSON they are dropped: people read the same in other texts."""
_FIELDS: Final = "fleet_fields"
_STDERR: Final = "stderr"


def is_wanted() -> bool:
    """Return True if this process logs as JSON. Any other value than `json` means text."""
    return os.environ.get(LOG_VARIABLE, "").lower() == JSON_FORMAT


def fields(**values: Any) -> dict[str, Any]:
    """Return the `extra` of a log call, with fields of its JSON line. Leave out empty values."""
    return {_FIELDS: {name: value for name, value in values.items() if value not in (None, "")}}


class JsonFormatter(logging.Formatter):
    """Formats a record as one line of JSON. A program of your own can use it, too."""

    def __init__(self, process: str) -> None:
        super().__init__()
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        """Return the line. It never contains a newline or a control character."""
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "process": self._process,
            "pid": record.process,
            "message": record.getMessage(),
            **getattr(record, _FIELDS, {}),
        }
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


class _JsonLines(io.TextIOBase):
    """Replaces stderr: text that is written there for a person becomes log lines, too."""

    encoding = "utf-8"
    errors = "replace"

    def __init__(self) -> None:
        self._rest = ""

    def writable(self) -> bool:
        """Return True."""
        return True

    def write(self, text: str) -> int:
        """Log each whole line."""
        *whole, self._rest = (self._rest + text).split("\n")
        for line in whole:
            self._log(line)
        return len(text)

    def end(self) -> None:
        """Log a last line without an end."""
        rest, self._rest = self._rest, ""
        self._log(rest)

    def _log(self, line: str) -> None:
        if line.strip():
            logging.getLogger(__name__).warning("%s", line, extra=fields(stream=_STDERR))


def begin(process: str) -> bool:
    """Let this process log as JSON if FLEET_LOG says so, from the first call on. Return True if it does."""
    if not is_wanted():
        return False
    if isinstance(sys.stderr, _JsonLines):
        return True
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter(process))
    logging.basicConfig(handlers=[handler], level=logging.INFO, force=True)
    sys.stderr = lines = _JsonLines()
    atexit.register(lines.end)
    return True


def message_in(line: str) -> tuple[str, str] | None:
    """Return level and message of a line that a process of ours has logged as JSON. None if it is not one.

    Text that a process wrote to stderr for a person counts as an error, because it may say why the process ended.
    """
    if not line.startswith("{"):
        return None
    try:
        found = json.loads(line)
        said = found.get("stream") == _STDERR
        return "ERROR" if said else str(found["level"]).upper(), str(found["message"])
    except (ValueError, KeyError, TypeError, AttributeError):
        return None
