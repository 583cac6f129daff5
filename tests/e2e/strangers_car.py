"""A stranger's Arduino car: a program of its own, which imports nothing of this repository.

It was written from docs/reference/protocol.md alone.
Run it with `--seed N`. It serves one TCP connection at a time; TCP only carries what a UART of 9600 baud would. The
first line on stdout is `{"port": ...}`. Then follows its true state, at each change and ten times a second: `t` (s
since the epoch), `motors`, `mode`, and `read` when it has read a string.

The car's program is a generator that yields when it waits, on a clock of its own: a car that the machine runs late
works off what it missed, with the times that it would have had.
"""

import argparse
import json
import random
import select
import socket
import sys
import time
from collections import deque
from collections.abc import Iterator

BYTE_S = 1 / 960
BUFFER_BYTES = 64
PIECE_BYTES = 20
REPORT_S = 1.0
TRUTH_S = 0.1
CLOCK_S = 1e-5
"""Resolution of the clock: seconds since the epoch, as a float, are no finer."""
MANUAL, REMOTE, TRACKING, AVOIDANCE, COLOR_LED, LIGHT_SEEKING, FOLLOWING = range(7)
DELAY, IDLE = "delay", "idle"
Waits = Iterator[tuple[str, float]]
"""Waits of the program: kind and end, s of its clock. `DELAY` sees no byte, `IDLE` ends with the next byte."""


class Uart:
    """Both directions of the serial port. Times: s of the car's clock."""

    def __init__(self) -> None:
        self._coming: deque[tuple[float, int]] = deque()
        self._last_in_at = self._last_out_at = 0.0
        self._leaving: deque[tuple[float, bytes]] = deque()

    def bring(self, data: bytes, now: float) -> None:
        """Take bytes of the carrier, at the pace of the wire."""
        for byte in data:
            self._last_in_at = max(now, self._last_in_at) + BYTE_S
            self._coming.append((self._last_in_at, byte))

    def next_byte_at(self) -> float:
        return self._coming[0][0] if self._coming else float("inf")

    def read(self, now: float) -> str:
        """Return the bytes in the buffer. Bytes that came while it was full are lost."""
        found = []
        while self._coming and self._coming[0][0] <= now:
            found.append(chr(self._coming.popleft()[1]))
        return "".join(found[:BUFFER_BYTES])

    def print(self, text: str, now: float) -> float:
        """Send a text. Return how long the call blocks: until the rest fits in the buffer."""
        for start in range(0, len(text), PIECE_BYTES):
            piece = text[start : start + PIECE_BYTES].encode()
            self._last_out_at = max(now, self._last_out_at) + len(piece) * BYTE_S
            self._leaving.append((self._last_out_at, piece))
        return max(0.0, self._last_out_at - now - BUFFER_BYTES * BYTE_S)

    def next_piece_at(self) -> float:
        return self._leaving[0][0] if self._leaving else float("inf")

    def take(self, now: float) -> bytes:
        """Return the pieces that have left the port."""
        found = b""
        while self._leaving and self._leaving[0][0] <= now:
            found += self._leaving.popleft()[1]
        return found


class Program:
    """The program of the car's processor."""

    def __init__(self, uart: Uart, seed: int, began: float) -> None:
        self.now = began
        self.motors = False
        self.mode = MANUAL
        self.truths: list[dict[str, object]] = []
        """New true states. The caller empties the list."""
        self._uart = uart
        self._chance = random.Random(seed)
        self._string = ""
        self._complete = False
        self._fan = False
        self._report_in = REPORT_S * self._chance.random()
        """Time to the next report. The program counts turns of the loop, so time in a block does not count."""
        self._obstacle_in = 3.0
        self._range_cm = 60.0
        self._main = self._loop()
        self._wait: tuple[str, float] = (DELAY, began)

    def wakes_at(self) -> float:
        kind, until = self._wait
        return min(until, max(self.now, self._uart.next_byte_at())) if kind == IDLE else until

    def run(self, until: float) -> None:
        while (at := self.wakes_at()) <= until:
            self.now = at
            self._wait = next(self._main)

    def tell(self, **more: object) -> None:
        self.truths.append({"t": self.now, "motors": self.motors, "mode": self.mode, **more})

    # ------------------------------------------------------------------ the loop

    def _loop(self) -> Waits:
        turns = {
            MANUAL: self._manual,
            REMOTE: self._remote,
            TRACKING: self._track,
            AVOIDANCE: self._avoid,
            COLOR_LED: self._show_colors,
            LIGHT_SEEKING: self._seek_light,
            FOLLOWING: self._follow,
        }
        while True:
            if self._complete:
                yield from self._parse()
            else:
                yield from turns[self.mode]()
            # The core calls serialEvent between two turns of the loop.
            self._string += (came := self._uart.read(self.now))
            self._complete = self._complete or "#" in came

    def _delay(self, seconds: float) -> Waits:
        yield DELAY, self.now + seconds

    def _set(self, *, motors: bool | None = None, mode: int | None = None) -> None:
        before = self.motors, self.mode
        self.motors = self.motors if motors is None else motors
        self.mode = self.mode if mode is None else mode
        if (self.motors, self.mode) != before:
            self.tell()

    def _parse(self) -> Waits:
        text, self._complete = self._string, False
        self.tell(read=text)
        if "MODE" in text:
            self._string = ""
            yield from self._change_mode(text[9:10], text[10:11])
        elif self.mode != MANUAL:
            self._string = ""
        elif "PTZ" in text or "CLR" in text:
            self._string = ""
            yield from self._delay(0.65 if "PTZ" in text else 0.10)
        elif "4WD" not in text:
            self._string = ""
            yield from self._obey(text)
        # The rest is an unknown named frame, or half a frame. It stays in the buffer.

    def _change_mode(self, which: str, opens: str) -> Waits:
        if opens == "0":
            self._set(motors=False, mode=MANUAL)
            yield from self._delay(1.0)
        elif which in tuple("123456"):
            self._set(mode=int(which))
            yield from self._delay(2.1 + 0.2 * (int(which) + 1))
        else:
            self._set(mode=MANUAL)
            yield from self._delay(2.3)

    def _obey(self, text: str) -> Waits:
        def field(place: int) -> str:
            return text[2 * place - 1 : 2 * place]

        self._set(motors=field(2) in tuple("12") or field(1) in tuple("1234"))
        if field(8) == "1":
            self._fan = not self._fan
        if field(3) == "1":
            yield from self._delay(0.30)
        if field(5) in tuple("12") or field(9) == "1":
            yield from self._delay(0.65)

    # ------------------------------------------------------------------ one turn of each mode

    def _manual(self) -> Waits:
        began = self.now
        yield IDLE, self.now + max(0.0, self._report_in)
        self._report_in -= self.now - began
        if self._report_in > CLOCK_S or self._fan:
            if self._fan:
                self._report_in = max(self._report_in, REPORT_S)
            return
        ranging_s = self._chance.uniform(0.004, 0.04)
        self._report_in = REPORT_S - ranging_s
        yield from self._delay(ranging_s)
        self._range_cm = min(300.0, max(10.0, self._range_cm + self._chance.uniform(-5, 5)))
        line, volts = self._bits(4), self._chance.uniform(7.7, 7.9)
        text = f"$4WD,CSB{self._range_cm:.2f},PV{volts:.2f},GS{self._chance.randrange(190, 230)},LF{line},"
        yield from self._print(f"{text}HW{self._bits(2)},GM{self._bits(2)}#")

    def _remote(self) -> Waits:
        # Somebody holds the infrared remote's button all the time.
        self._set(motors=True)
        yield IDLE, self.now + 0.5

    def _track(self) -> Waits:
        self._set(motors=True)
        yield from self._print(f"$4WD,CSB0,PV8,GS0,LF{self._bits(4)},HW00,GM00#")
        yield from self._delay(self._chance.choice((0.002, 0.002, 0.08)))

    def _seek_light(self) -> Waits:
        self._set(motors=True)
        yield from self._print(f"$4WD,CSB120,PV8.3,GS000,LF0000,HW00,GM{self._bits(2)}#")
        yield from self._delay(0.002)

    def _follow(self) -> Waits:
        self._set(motors=True)
        yield from self._print(f"$4WD,CSB120,PV8.3,GS000,LF0000,HW{self._bits(2)},GM00")
        yield from self._delay(0.002)

    def _show_colors(self) -> Waits:
        yield from self._delay(0.75)

    def _avoid(self) -> Waits:
        self._obstacle_in -= 0.1
        if self._obstacle_in > 0:
            self._set(motors=True)
            yield from self._delay(0.1)
            return
        # The car brakes, looks left and right, and spins to the free side: 4.3 s in which it reads no byte.
        self._obstacle_in = self._chance.uniform(1.0, 6.0)
        self._set(motors=False)
        yield from self._delay(3.3)
        self._set(motors=True)
        yield from self._delay(1.0)

    def _print(self, text: str) -> Waits:
        yield from self._delay(self._uart.print(text, self.now))

    def _bits(self, count: int) -> str:
        return "".join(self._chance.choice("01") for _ in range(count))


class Carrier:
    """The TCP server. It serves one connection at a time, and a second one has to wait."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._peer: socket.socket | None = None

    def wait(self, seconds: float) -> bytes:
        """Wait for bytes within this time, and return them."""
        (ready, _, _) = select.select([self._peer or self._listener], [], [], max(0.0, seconds))
        if not ready:
            return b""
        if self._peer is None:
            self._peer, _ = self._listener.accept()
            self._peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return b""
        try:
            data = self._peer.recv(4096)
        except OSError:
            data = b""
        if not data:
            self._hang_up()
        return data

    def send(self, data: bytes) -> None:
        """Send bytes if there is a connection. A UART sends in any case."""
        if self._peer is not None and data:
            try:
                self._peer.sendall(data)
            except OSError:
                self._hang_up()

    def _hang_up(self) -> None:
        if self._peer is not None:
            self._peer.close()
        self._peer = None


def main() -> None:
    """Be a car until a signal ends it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    seed = parser.parse_args().seed
    carrier, uart = Carrier(), Uart()
    print(json.dumps({"port": carrier.port}), flush=True)
    program = Program(uart, seed, time.time())
    told_at = 0.0
    while True:
        now = time.time()
        program.run(now)
        carrier.send(uart.take(now))
        if now >= told_at + TRUTH_S:
            told_at = now
            program.truths.append({"t": now, "motors": program.motors, "mode": program.mode})
        if program.truths:
            sys.stdout.write("".join(json.dumps(each) + "\n" for each in program.truths))
            sys.stdout.flush()
            program.truths.clear()
        due = min(program.wakes_at(), uart.next_piece_at(), told_at + TRUTH_S)
        if data := carrier.wait(due - time.time()):
            uart.bring(data, time.time())


if __name__ == "__main__":
    main()
