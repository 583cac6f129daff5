"""What the commands for a person with a car on the desk share: words, colour, how they end. No link is opened here."""

import argparse
import os
import re
import signal
import sys
from collections.abc import Callable, Coroutine, Iterable
from typing import IO, Any, Final

from gateway.capture import BadCapture
from gateway.link import BadUrl, LinkError, LinkUrl
from gateway.link.url import TcpUrl
from gateway.protocol.platforms import Profile, parse_platform
from schemas.process import startup, stdio

LINK_HELP: Final = "/dev/ttyUSB0, serial://?vid=1a86&serial=ABC, tcp://host:8888, ble://ADDRESS or ble://name=BT04"
PLATFORM_HELP: Final = "arduino, stm32, raspberry_pi; +arm, +imu (default unknown)"
_ODD: Final = re.compile(r"[^ -\[\]-~]")
_COLOURS: Final = {"red": "31", "yellow": "33", "cyan": "36", "dim": "2"}


class WrongUse(Exception):
    """What the user asked for cannot be; the text is one line: what, where, what to do."""


class Failed(Exception):
    """What was asked for could not be done; the text is one line."""


def describe(parser: argparse.ArgumentParser, description: str, epilog: str) -> None:
    """Give a command its words."""
    parser.description, parser.epilog = description, epilog
    parser.formatter_class = argparse.RawDescriptionHelpFormatter


def explained(name: str, run: Callable[[], None]) -> int:
    """Run a command; what a user can cause becomes one line and an exit code: 2 wrong use, 1 a failure, 130 Ctrl-C."""
    try:
        startup.interruptible()
        run()
        sys.stdout.flush()
    except (WrongUse, BadUrl, BadCapture) as error:
        return _told(f"{name}: {error}", 2)
    except (Failed, LinkError) as error:
        return _told(f"{name}: {error}", 1)
    except KeyboardInterrupt:
        return startup.INTERRUPTED
    except OSError as error:  # the commands explain what they open; this is the output's
        stdio.silence(sys.stdout)
        quiet = isinstance(error, BrokenPipeError)  # whoever closed a pipe has seen enough
        return 1 if quiet else _told(f"{name}: the output cannot be written: {error.strerror}", 1)
    return 0


def _told(words: str, code: int) -> int:
    sys.stderr.write(words + "\n")
    return code


def profile_of(text: str) -> Profile:
    """The profile of `--platform`; raises WrongUse."""
    try:
        return parse_platform(text)
    except ValueError as error:
        raise WrongUse(str(error)) from None


def printable(data: bytes) -> str:
    r"""Bytes from a car as text for a terminal: a backslash, and what is not printable ASCII, as \xNN."""
    return _ODD.sub(lambda odd: f"\\x{ord(odd[0]):02x}", data.decode("latin-1"))


def warn_of(url: LinkUrl) -> None:
    """Say, before it is opened, what opening and closing this link may do to a car."""
    if isinstance(url, TcpUrl):
        note(
            f"{url}: a Raspberry Pi car's program dies when its TCP client goes away, this one included, and its "
            "motors stay as they were"
        )


def note(words: str) -> None:
    """A line for the person, on stderr."""
    sys.stderr.write(f"note: {words}\n")
    sys.stderr.flush()


def say(lines: Iterable[str]) -> None:
    """What a person must know, on stdout; where that cannot be written on stderr, and then OSError is raised."""
    text = "".join(f"{line}\n" for line in lines)
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except OSError:
        sys.stderr.write(text)
        raise


class Paint:
    """Colour for a terminal; plain in a pipe, with NO_COLOR, and on a terminal that has none."""

    def __init__(self, stream: IO[str]) -> None:
        plain = bool(os.environ.get("NO_COLOR")) or os.environ.get("TERM") == "dumb"
        self._on = stream.isatty() and not plain

    def __call__(self, colour: str, text: str) -> str:
        """The text in this colour."""
        return f"\x1b[{_COLOURS[colour]}m{text}\x1b[0m" if self._on and text else text


def run_until_interrupted(work: Coroutine[Any, Any, None]) -> None:
    """Run it; what ends a process is taken as Ctrl-C is: the work may clean up, and KeyboardInterrupt is raised."""
    import asyncio

    from schemas.process import signals

    with signals.taken_as_ctrl_c(lambda: signal.raise_signal(signal.SIGINT)):
        asyncio.run(work)
