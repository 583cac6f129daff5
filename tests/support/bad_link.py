"""A link that loses and delays: `python bad_link.py DEVICE DEVICE LOSS DELAY_S SEED`. Needs Linux and root.

It passes Ethernet frames between two devices of this network namespace, each way with this loss (a share) and delay,
because not each kernel has netem. The kernel must segment packets and compute their checksums before the devices, so
that a frame here is a frame on the wire.
"""

import ctypes
import fcntl
import heapq
import itertools
import random
import select
import socket
import struct
import sys
import time
from typing import Final

_ALL: Final = 0x0003
"""ETH_P_ALL."""
_SIOCETHTOOL: Final = 0x8946
_OFFLOADS: Final = (0x14, 0x17, 0x1F, 0x24, 0x2C)
"""ETHTOOL_SRXCSUM, STXCSUM, STSO, SGSO and SGRO: off."""
_MAX_FRAME: Final = 65_536


def without_offloads(device: str) -> None:
    """Let the kernel compute sums and segment packets before they enter a device."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ask:
        for command in _OFFLOADS:
            value = ctypes.create_string_buffer(struct.pack("II", command, 0))
            request = struct.pack("16sP", device.encode(), ctypes.addressof(value))
            fcntl.ioctl(ask, _SIOCETHTOOL, request)


def _pass_on(names: tuple[str, str], loss: float, delay_s: float, seed: int) -> None:
    rng, numbers = random.Random(seed), itertools.count()
    sockets = [socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(_ALL)) for _ in names]
    for each, name in zip(sockets, names, strict=True):
        each.bind((name, _ALL))
    other = dict(zip(sockets, reversed(sockets), strict=True))
    waiting: list[tuple[float, int, socket.socket, bytes]] = []
    while True:
        wait_s = max(0.0, waiting[0][0] - time.monotonic()) if waiting else None
        for each in select.select(sockets, [], [], wait_s)[0]:
            frame, (_, _, kind, *_) = each.recvfrom(_MAX_FRAME)
            if kind != socket.PACKET_OUTGOING and rng.random() >= loss:
                heapq.heappush(waiting, (time.monotonic() + delay_s, next(numbers), other[each], frame))
        while waiting and waiting[0][0] <= time.monotonic():
            _, _, to, frame = heapq.heappop(waiting)
            try:
                to.send(frame)
            except OSError:  # the device is down: the link is cut
                continue


if __name__ == "__main__":
    here, there = sys.argv[1:3]
    for device in (here, there):
        without_offloads(device)
    print("true", flush=True)
    _pass_on((here, there), float(sys.argv[3]), float(sys.argv[4]), int(sys.argv[5]))
