"""A client that floods a bus. Arguments: kind, messages per second, seconds. It prints the number of sent messages."""

import contextlib
import json
import sys
import time
from collections.abc import Callable
from typing import Any

import zenoh

from schemas import bus, keys, messages
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import Qos

LARGE = 5_000_000
NAMES = 200
"""Number of names of tokens. With ever more names, the hub becomes slow, and with the hub any other process."""
AT_ONCE = 64
"""Maximum number of pending queries."""


def _history(opened: bus.Bus) -> Callable[[int], object]:
    replies: list[Any] = []

    def ask(_: int) -> None:
        channel: Any = zenoh.handlers.RingChannel(1)  # nobody reads the answers
        replies.append(opened._session.get("fleet/red/sensor/*?last=1500;format=json", channel, timeout=5.0))
        del replies[:-AT_ONCE]

    return ask


def _tokens(opened: bus.Bus, expression: str, names: int) -> Callable[[int], object]:
    def blink(number: int) -> None:
        token = opened._session.liveliness().declare_token(expression.format(number % names))
        token.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub has no return type

    return blink


def _talkers(opened: bus.Bus) -> Callable[[int], object]:
    """Return a function that declares a gateway's token, publishes a state, and undeclares the token."""
    payload, encoding = pb.Health(platform="arduino").SerializeToString(), messages.encoding_of("fleet.v1.Health")

    def say(number: int) -> None:
        token = opened._session.liveliness().declare_token(f"fleet/car{number}")
        opened.put_again(f"fleet/car{number}/state/health", payload, encoding, 1, Qos.STATE)
        token.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub has no return type

    return say


def _large(opened: bus.Bus) -> Callable[[int], object]:
    payload = json.dumps({"motion": "forward", "duration_s": 1, "sender": "x" * LARGE}).encode()

    def ask(_: int) -> None:
        for _answer in opened.query("fleet/red/@cmd/drive", payload=payload, encoding=messages.JSON, timeout_s=5.0):
            pass

    return ask


def _drives(opened: bus.Bus) -> Callable[[int], object]:
    drives = [
        json.dumps({"motion": motion, "duration_s": 0.5, "sender": "flood", "kind": "script"}).encode()
        for motion in ("forward", "back", "left", "right")
    ]
    key = keys.command_key("fleet", "red", "drive")
    return lambda number: opened.put_command(key, drives[number % 4], messages.JSON, number)


FLOODS: dict[str, Callable[[bus.Bus], Callable[[int], object]]] = {
    "history": _history,
    "operators": lambda opened: _tokens(opened, "fleet/@operator/ann{}", NAMES),
    "cars": lambda opened: _tokens(opened, "fleet/car{}", NAMES),
    "names": lambda opened: _tokens(opened, "fleet/car{}", sys.maxsize),
    "talkers": _talkers,
    "large": _large,
    "drives": _drives,
}


def main() -> None:
    kind, rate, seconds = sys.argv[1], float(sys.argv[2]), float(sys.argv[3])
    with bus.Bus.open() as opened:
        send, began, number = FLOODS[kind](opened), time.monotonic(), 0
        while (now := time.monotonic() - began) < seconds:
            while number < min(now, seconds) * rate and time.monotonic() - began < seconds:
                with contextlib.suppress(zenoh.ZError):
                    send(number)
                number += 1
            time.sleep(0.002)
    print(number)


if __name__ == "__main__":
    main()
