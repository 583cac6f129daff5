"""Bytes that a UART misreads, because the other end of the line sends at another baud rate. Pure."""

from math import ceil


def misread(data: bytes, *, sent_at: int, read_at: int) -> bytes:
    """Return what a UART at `read_at` baud reads of bytes sent at `sent_at` baud. The line rests before and after them.

    The UART samples the middle of each of its bits after a falling edge, and ignores a wrong stop bit. A faster one
    sees each bit several times, so its bytes consist of long runs. A slower one sees several bits as one.
    """
    # One level for each bit that was sent: the start bit, eight bits from the lowest on, the stop bit.
    line = [level for byte in data for level in (0, *(byte >> bit & 1 for bit in range(8)), 1)]
    step = sent_at / read_at
    read, at = bytearray(), 0.0
    while (edge := _next(line, 0, at)) is not None:
        at = edge
        if _level(line, at + step / 2):  # shorter than half a bit: no start bit
            rest = _next(line, 1, at)
            at = float(len(line)) if rest is None else rest
            continue
        read.append(sum(_level(line, at + step * (1.5 + bit)) << bit for bit in range(8)))
        at += step * 9.5
        rest = _next(line, 1, at)  # the line must rest before the next start bit
        at = float(len(line)) if rest is None else rest
    return bytes(read)


def _level(line: list[int], at: float) -> int:
    return line[int(at)] if at < len(line) else 1


def _next(line: list[int], level: int, at: float) -> float | None:
    """Return the first time from `at` on at which the line has this level, or None if it never has."""
    if at < len(line) and line[int(at)] == level:
        return at
    return next((float(index) for index in range(ceil(at), len(line)) if line[index] == level), None)
