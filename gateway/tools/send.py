"""`gateway send`: checks one frame against docs/reference/protocol.md, sends it, and prints what the car may do then.

It is for experiments with a car on the desk. It does not pace or repeat frames, and does not stop the car.
`gateway run` drives a car safely.
"""

import argparse
import asyncio
import contextlib
import re
import shlex
from typing import Final

from gateway.drivers.yahboom.protocol.frames import (
    ArmSet,
    ColorLed,
    Frame,
    General,
    LoneHash,
    ModeClose,
    ModeOpen,
    Ptz,
    encode,
    parse_sent,
)
from gateway.drivers.yahboom.protocol.modes import MODES
from gateway.drivers.yahboom.protocol.platforms import Profile, StopStyle
from gateway.drivers.yahboom.protocol.timing import BYTES_PER_S, FRAME_S, LONGEST_BLOCK_S
from gateway.link import Link, LinkLost, LinkUrl, open_link, parse_url
from gateway.tools import cli_support
from schemas.links import LINK_HELP
from schemas.words import Mode, Motion, Platform

DESCRIPTION: Final = (
    "Check one frame against the table, send it to a car on the desk, and say what the car may do then."
)
EPILOG: Final = """\
examples (use single quotes, because in double quotes the shell replaces $0 and $4):
  gateway send --link /dev/ttyUSB0 '$0,0,1,0,0,0,0,0,0#'                        sound once
  gateway send --link /dev/ttyUSB0 '$1,0,0,0,0,0,0,0,0#'                        drive on, for ever
  gateway send --link /dev/ttyUSB0 '$0,0,0,0,0,0,0,0,0#'                        stop
  gateway send --link /dev/ttyUSB0 --platform arduino '$4WD,PTZ90#'             only some cars understand it

A car continues its last motion for ever, so put it on blocks. To drive a car safely, use `gateway run`.
Opening a serial port can reset an Arduino that is on a USB cable. It misses every frame during its start, which takes
two seconds. With --wait 3s the frame is sent after the start."""

MAX_WAIT_S: Final = 60.0
REFUSAL_S: Final = 0.5
"""Time after the write in which the end of the link shows that the frame may not have arrived. A bridge that has a
client already accepts another connection, says so, and closes it."""
_STOP: Final = encode(General(Motion.STOP)).decode()
_MANUAL: Final = encode(ModeClose()).decode()
_FORMS: Final = (
    f"nine digits as in '{_STOP}', '$4WD,PTZ<0..180>#', '$4WD,CLR<0..255>,CLG<0..255>,CLB<0..255>#', "
    f"'$4WD,MODE<0..{max(row.digit for row in MODES.values())}><0 or 1>#', or '$4WD,ServoJ1<0..180>,J2...,J6<0..180>#'"
)
_PLACES: Final = ("motion", "rotate", "whistle", "speed", "servo", "sing", "light", "fan", "servo reset")
# The rest of a frame after a shell has replaced its `$0` or `$4` by the shell's name or by nothing.
_EXPANDED: Final = re.compile(r"(?P<name>[^,$]*)(?P<rest>(?:,\d){8}#?)|(?P<named>WD,[A-Za-z0-9,]+#?)")


class _EndedAfterWrite(LinkLost):
    """The link ended right after the frame was written, so the frame may not have arrived."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    cli_support.describe(parser, DESCRIPTION, EPILOG)
    parser.add_argument("--link", required=True, metavar="URL", help=LINK_HELP)
    platform_help = cli_support.PLATFORM_HELP + ". It decides which frames are allowed"
    parser.add_argument("--platform", default=Platform.UNKNOWN, help=platform_help)
    parser.add_argument("--wait", metavar="DURATION", help="how long to wait after opening the link (default: 0s)")
    parser.add_argument("--raw", action="store_true", help="send the text without a check")
    parser.add_argument("frame", metavar="FRAME", help=f"the frame in single quotes, for example '{_STOP}'")


def run(arguments: argparse.Namespace) -> int:
    """Send the frame and return the exit code."""
    return cli_support.run_command("gateway send", lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> None:
    url, profile = parse_url(arguments.link), cli_support.profile_of(arguments.platform)
    wait_s = 0.0 if arguments.wait is None else cli_support.duration("--wait", arguments.wait, 0.0, MAX_WAIT_S)
    data = raw_bytes(arguments.frame) if arguments.raw else check_frame(arguments.frame, profile, url)
    cli_support.warn_before_opening(url)
    words, after = cli_support.printable(data), aftermath(profile.parse_sent(data), profile, arguments.link)
    try:
        cli_support.run_until_interrupted(_send(url, data, wait_s))
    except _EndedAfterWrite:
        cli_support.print_lines(
            [f"wrote {words} to {url}, and the link ended: perhaps it did not arrive. If it did:", *after]
        )
        raise
    cli_support.print_lines([f"sent {words} to {url}", *after])


async def _send(url: LinkUrl, data: bytes, wait_s: float) -> None:
    link = await open_link(url)
    try:
        await _watch(link, wait_s)
        await link.write(data)
        try:
            # Wait until the bytes are sent: a port that is closed earlier may truncate them.
            await _watch(link, max(REFUSAL_S, len(data) / BYTES_PER_S + FRAME_S))
        except LinkLost as error:
            raise _EndedAfterWrite(str(error)) from None
    finally:
        await link.close()


async def _watch(link: Link, seconds: float) -> None:
    """Wait, and discard what the car sends meanwhile. Raises LinkLost if the link ends."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            while True:
                await link.read()


def raw_bytes(text: str) -> bytes:
    """Return the text as bytes, one per character. Raises WrongUse if a character is not a byte."""
    try:
        data = text.encode("latin-1")
    except UnicodeEncodeError as error:
        raise cli_support.WrongUse(f"frame {text!r}: {text[error.start]!r} is not a byte: use ASCII") from None
    if not data:
        raise cli_support.WrongUse(f"frame '' is empty: give one as '{_STOP}'")
    return data


def check_frame(text: str, profile: Profile, url: LinkUrl) -> bytes:
    """Return the bytes of the frame.

    Raises WrongUse if it is not a frame of the protocol, if this car does not know it, or if the car would drive behind
    a link whose end kills the program of a Raspberry Pi car.
    """
    frame = profile.parse_sent(raw_bytes(text))
    if frame is None:
        raise cli_support.WrongUse(f"frame {text!r}: {why_not(text)} (--raw sends it anyway)")
    refusal = profile.refusal(frame)
    if refusal is not None:
        raise cli_support.WrongUse(
            f"frame {text!r}: {refusal} (name the car's platform with --platform; --raw sends the frame anyway)"
        )
    if url.harm and moves(frame) and profile.stop_style is not StopStyle.MODE_FRAME:
        raise cli_support.WrongUse(
            f"frame {text!r}: the car would drive, and a Raspberry Pi car's program dies when this connection closes. "
            "Then nothing can stop the car: use `gateway run` (or --platform arduino behind a bridge, or --raw)"
        )
    return profile.encode(frame)


def why_not(text: str) -> str:
    """Return the reason why a text is not a frame of the protocol, for a person."""
    if expanded := _EXPANDED.fullmatch(text):
        rest = expanded["rest"]
        # `$1`..`$4` are empty in a shell, `$0` is its name.
        meant = f"${'0' if expanded['name'] else '<digit>'}{rest}" if rest else f"$4{expanded['named']}"
        meant += "" if meant.endswith("#") else "#"
        return f"the shell has replaced the $ and the digit after it: put the frame in single quotes, '{meant}'"
    if not text.startswith("$"):
        return f"a frame begins with '$'; there are: {_FORMS}"
    if not text.endswith("#"):
        return f"a frame ends with '#': '{text}#'?"
    if text == "$4WD,MODE01#":
        return f"mode 0 cannot be opened; '{_MANUAL}' closes the open mode"
    places = text[1:-1].split(",")
    if text.startswith("$4WD,"):
        return f"it is not in the table; there are: {_FORMS}"
    if len(places) != len(_PLACES):
        return f"it has {len(places)} of the nine places of a general frame ({', '.join(_PLACES)})"
    for index, (name, value) in enumerate(zip(_PLACES, places, strict=True)):
        allowed = [digit for digit in "012345678" if _is_frame(index, digit)]
        if value not in allowed:
            return f"place {index + 1} ({name}) is {value!r}, allowed are {allowed[0]}..{allowed[-1]}"
    return "a servo is moved (place 5) and reset (place 9) at once"


def _is_frame(index: int, digit: str) -> bool:
    places = ["0"] * len(_PLACES)
    places[index] = digit
    return parse_sent(f"${','.join(places)}#".encode()) is not None


def moves(frame: Frame) -> bool:
    """Return True if the car may drive after this frame."""
    match frame:
        case General(motion):
            return motion is not Motion.STOP
        case ModeOpen():
            return True
        case Ptz() | ColorLed() | ModeClose() | ArmSet() | LoneHash():
            return False


def aftermath(frame: Frame | None, profile: Profile, link: str) -> list[str]:
    """Return lines for a person that say what the car may do now, and how to stop it."""
    again = f"gateway send --link {shlex.quote(link)}"
    lines = ["cars do not answer; `gateway monitor` shows what the car sends"]
    match frame:
        case General(motion) as general:
            if motion is Motion.STOP:
                lines.append(
                    "its motors are off if it is in mode 0 and was not busy; in another mode only an stm32 car obeys it"
                )
            else:
                lines.append(f"in mode 0 it drives ({motion}) until the next command, even without a link")
            if general.fan:
                lines.append("its fan is toggled; while the fan runs, an arduino car sends no readings")
        case ModeOpen(mode):
            lines.append(
                f"it is opening mode {mode}, which takes up to {LONGEST_BLOCK_S:g} s. Until then its motors "
                "stay as they were (an stm32 car turns them off at once)"
            )
            then = "obeys" if mode in (Mode.REMOTE_CONTROL, Mode.COLOR_LED) else "drives by itself, and obeys"
            lines.append(
                f"then it {then} only a mode frame (an stm32 car also general frames). To stop it, in mode 0: "
                f"{again} '{_MANUAL}'"
            )
        case ModeClose():
            lines.append("its motors are off and it is in mode 0, as soon as it is not busy (up to 4.3 s in avoidance)")
        case Ptz() | ColorLed() | ArmSet():
            lines.append("its motors do not change; in a mode other than 0 an arduino car ignores this")
        case LoneHash():
            lines.append("this ended half a frame in the car's buffer, and the car may have obeyed that half")
        case None:
            lines.append(
                "this frame is not in the table: its effect is unknown. The car may drive, or ignore the next frames"
            )
    if frame is None or (isinstance(frame, General) and moves(frame)):
        lines.append(f"stop it: {again} '{_STOP}'")
        if profile.kind is not Platform.RASPBERRY_PI:
            lines.append(f"     or: {again} '{_MANUAL}', which works in every mode, but not on a Raspberry Pi car")
    return lines
