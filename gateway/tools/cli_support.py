"""Shared parts of the commands `scan`, `monitor` and `send`: help, color, exit codes."""

import argparse
import re
import signal
import sys
from collections.abc import Callable, Coroutine, Iterable
from typing import IO, Any, Final

from gateway import drivers
from gateway.capture import BadCapture
from gateway.drivers.yahboom.protocol.platforms import Profile, parse_platform
from gateway.link import BadUrl, LinkError, LinkUrl
from schemas.duration import parse_duration
from schemas.platform_name import kind_of, normalize_name
from schemas.process import startup, stdio
from schemas.words import Platform

PLATFORM_HELP: Final = "the car: arduino, stm32 or raspberry_pi, with options as in arduino+arm (default: unknown)"
_UNPRINTABLE: Final = re.compile(r"[^ -\[\]-~]")
_COLORS: Final = {"red": "31", "yellow": "33", "cyan": "36", "dim": "2"}


class WrongUse(Exception):
    """Wrong use of a command. The message is one line: what, where, what to do."""


class Failed(Exception):
    """A command failed. The message is one line."""


def describe(parser: argparse.ArgumentParser, description: str, epilog: str) -> None:
    """Set the help of a command."""
    parser.description, parser.epilog = description, epilog
    parser.formatter_class = argparse.RawDescriptionHelpFormatter


def run_command(name: str, run: Callable[[], None]) -> int:
    """Run a command, print its error as one line, and return the exit code: 1 failure, 2 wrong use, 130 Ctrl-C."""
    try:
        startup.interruptible()
        run()
        sys.stdout.flush()
    except (WrongUse, BadUrl, BadCapture) as error:
        return _fail(f"{name}: {error}", 2)
    except (Failed, LinkError) as error:
        return _fail(f"{name}: {error}", 1)
    except KeyboardInterrupt:
        return startup.INTERRUPTED
    except OSError as error:  # the commands handle errors of files and links, so this one is an error of the output
        return stdio.silence_broken(error, name)
    return 0


def _fail(message: str, code: int) -> int:
    sys.stderr.write(message + "\n")
    return code


def duration(option: str, text: str, min_s: float, max_s: float) -> float:
    """Return the duration of an option in seconds. Raises WrongUse if it is not allowed."""
    try:
        return parse_duration(text, min_s, max_s)
    except ValueError as error:
        raise WrongUse(f"{option}: {error}") from None


def profile_of(text: str) -> Profile:
    """Return the profile that `--platform` names. Raises WrongUse if these commands do not know its frames."""
    try:
        return parse_platform(text)
    except ValueError as error:
        kind = kind_of(normalize_name(text))
        if kind in tuple(Platform) or kind not in drivers.platforms():
            raise WrongUse(str(error)) from None
        raise WrongUse(
            f"{kind} cars speak another protocol, and this command knows only `$...#` frames. Serve the car with "
            "`gateway run`; `fleet watch CAR/frame/rx` then shows its bytes."
        ) from None


def printable(data: bytes) -> str:
    r"""Return bytes from a car as text for a terminal, with \xNN for a backslash and everything but printable ASCII."""
    return _UNPRINTABLE.sub(lambda found: f"\\x{ord(found[0]):02x}", data.decode("latin-1"))


def warn_before_opening(url: LinkUrl) -> None:
    """Print a warning if opening and closing this link may harm a car."""
    if url.harm:
        print_note(f"{url}: {url.harm}")


def print_note(text: str) -> None:
    """Print a note for a person to stderr."""
    sys.stderr.write(f"note: {text}\n")
    sys.stderr.flush()


def print_lines(lines: Iterable[str]) -> None:
    """Print lines that a person must see. If stdout cannot be written, print them to stderr and raise OSError."""
    text = "".join(f"{line}\n" for line in lines)
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except OSError:
        sys.stderr.write(text)
        raise


class Paint:
    """Colors text for a terminal. In a pipe, with NO_COLOR, or on a terminal without colors, the text stays plain."""

    def __init__(self, stream: IO[str]) -> None:
        self._on = stdio.shows_colors(stream)

    def __call__(self, color: str, text: str) -> str:
        """Return the text in this color."""
        return f"\x1b[{_COLORS[color]}m{text}\x1b[0m" if self._on and text else text


def run_until_interrupted(work: Coroutine[Any, Any, None]) -> None:
    """Run the work. On a termination signal, let it clean up, and then raise KeyboardInterrupt as after Ctrl-C."""
    import asyncio

    from schemas.process import signals

    with signals.taken_as_ctrl_c(lambda: signal.raise_signal(signal.SIGINT)):
        asyncio.run(work)
