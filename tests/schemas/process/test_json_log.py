"""Log lines as JSON: one line each, whatever is in them. tests/e2e/test_json_log.py follows a command by them."""

import json
import logging
import os
import subprocess
import sys

from schemas.process import json_log
from schemas.process.json_log import JsonFormatter, fields, message_in


def line_of(message: str, *arguments: object, level: int = logging.INFO, **values: object) -> str:
    logger = logging.getLogger("test")
    record = logger.makeRecord("test", level, __file__, 1, message, arguments, None, extra=fields(**values))
    return JsonFormatter("gateway").format(record)


def test_json_log_line_is_one_object_whatever_its_texts() -> None:
    line = line_of('%s "said"\n{"level": "error"}\x1b[31m', "\udcff\u2028", car="red", code="", words=None, odd={1})
    assert line.isascii()
    assert line.isprintable()
    found = json.loads(line)
    assert found["message"] == '\udcff\u2028 "said"\n{"level": "error"}\x1b[31m'
    assert (found["car"], found["odd"], found["process"], found["level"]) == ("red", "{1}", "gateway", "info")
    assert not {"code", "words"} & set(found)
    assert found["time"].endswith("+00:00")


def test_supervisor_reads_the_words_of_such_a_line() -> None:
    assert message_in(line_of("no link", level=logging.ERROR)) == ("ERROR", "no link")
    assert message_in(line_of("no link", level=logging.WARNING)) == ("WARNING", "no link")
    assert message_in(line_of("bye", level=logging.WARNING, stream="stderr")) == ("ERROR", "bye")
    for other in ("", "{", "[1]", "{}", "12:00:00 UTC ERROR no link", '{"level": "error"}', "null"):
        assert message_in(other) is None


def test_last_line_without_an_end_is_logged_too() -> None:
    script = 'import sys; from schemas.process import json_log; json_log.begin("x"); sys.stderr.write("one\\ntwo")'
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, json_log.LOG_VARIABLE: "json"},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert [message_in(line) for line in done.stderr.splitlines()] == [("ERROR", "one"), ("ERROR", "two")]
