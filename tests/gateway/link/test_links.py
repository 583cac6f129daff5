"""One suite for every kind of link: a real PTY, a real TCP server, a fake BlueZ behind bleak's own backend.

Bluetooth is tested on Linux only: elsewhere bleak uses the system's own Bluetooth, which no fake can replace.
"""

import asyncio
import contextlib
import gc
import random
import re
import socket
import struct
import sys
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import pytest
import serial

from gateway.drivers.yahboom.protocol.frame_splitter import FrameSplitter
from gateway.drivers.yahboom.protocol.sensors import Sensors
from gateway.link import Busy, CannotOpen, Link, LinkLost, open_link
from gateway.link.tcp import TcpLink
from schemas.links import TcpUrl
from tests.gateway.link.peers import (
    BlePeer,
    Peer,
    PtyPeer,
    TcpPeer,
    link_threads,
    no_threads,
    open_descriptors,
    settled,
)

FRAME = b"$4WD,CSB125,PV8.3,GS214,LF1011,HW01,GM10#"
STOP = b"$0,0,0,0,0,0,0,0,0#"
PATIENCE_S = 20.0


LINKS = ["serial", "tcp", *(["ble"] if sys.platform == "linux" else [])]


@pytest.fixture(params=LINKS)
async def peer(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[Peer]:
    made: Peer = {"serial": lambda: PtyPeer(tmp_path), "tcp": TcpPeer, "ble": BlePeer}[request.param]()
    yield made
    made.close()
    if isinstance(made, BlePeer):
        await settled()


@pytest.fixture
async def link(peer: Peer) -> AsyncIterator[Link]:
    opened = await open_link(peer.url)
    if isinstance(peer, TcpPeer):
        assert peer.peer, "taken"
    yield opened
    await opened.close()


async def read(link: Link, size: int) -> bytes:
    """Read exactly `size` bytes."""
    data = b""
    async with asyncio.timeout(PATIENCE_S):
        while len(data) < size:
            piece = await link.read()
            assert piece, "a read gives at least one byte"
            data += piece
    assert len(data) == size
    return data


async def until_lost(again: Callable[[], Awaitable[object]]) -> str:
    """Repeat a call until the link is lost. Return the message."""
    async with asyncio.timeout(PATIENCE_S):
        words = ""
        while not words:
            try:
                await again()
                await asyncio.sleep(0)
            except LinkLost as error:
                words = str(error)
    assert "\n" not in words
    return words


async def lost(link: Link) -> str:
    """Read until the link is lost. Return the message."""
    return await until_lost(link.read)


async def test_bytes_go_both_ways_unchanged(link: Link, peer: Peer) -> None:
    every = bytes(range(256)) * 4
    peer.send(every)
    assert await read(link, len(every)) == every
    for frame in (STOP, FRAME, b"#", bytes(range(256))):
        await link.write(frame)
        assert peer.receive(len(frame)) == frame


async def test_byte_by_byte_and_slowly(link: Link, peer: Peer) -> None:
    for index in range(len(FRAME)):
        peer.send(FRAME[index : index + 1])
        assert await read(link, 1) == FRAME[index : index + 1], "each byte is handed on when it comes"
    sender = asyncio.create_task(asyncio.to_thread(lambda: [(time.sleep(0.002), peer.send(b"%c" % c)) for c in FRAME]))
    assert await read(link, len(FRAME)) == FRAME
    await sender


async def test_lossy_and_noisy(link: Link, peer: Peer) -> None:
    """The link passes bytes unchanged and adds none, and the next good frame decodes."""
    noise = random.Random(7)
    sent, whole = b"", 0
    for _ in range(40):
        damaged = bytes(byte for byte in FRAME if noise.random() < 0.9)
        junk = noise.randbytes(noise.randrange(60)).replace(b"$", b"").replace(b"#", b"")
        for piece in (damaged, junk, FRAME):
            peer.send(piece)
            sent += piece
        whole += 1
    received = await read(link, len(sent))
    assert received == sent
    decoder = FrameSplitter()
    events = [event for at in range(0, len(received), 20) for event in decoder.feed(received[at : at + 20], 1.0)]
    assert len([event for event in events if isinstance(event, Sensors)]) >= whole


async def test_dying_in_the_middle_of_a_frame(link: Link, peer: Peer) -> None:
    peer.send(FRAME[:17])
    assert await read(link, 17) == FRAME[:17]
    peer.die()
    words = await lost(link)
    assert words.startswith(str(peer.url))
    assert " is gone: " in words
    assert await lost(link) == words, "asked again it says the same"
    with pytest.raises(LinkLost):
        await link.write(STOP)
    await link.close()
    assert await lost(link) == words, "closing it does not cover up why it was lost"


async def test_bytes_before_link_end_are_read(peer: Peer) -> None:
    """A PTY is excluded: the system discards unread bytes when the port disappears."""
    link = await open_link(peer.url)
    if not isinstance(peer, PtyPeer):
        peer.send(FRAME)
        peer.die()
        assert await read(link, len(FRAME)) == FRAME
    else:
        peer.die()
    await lost(link)
    await link.close()


async def test_write_after_link_death_is_reported_lost(link: Link, peer: Peer) -> None:
    peer.die()
    words = await until_lost(lambda: link.write(STOP))
    assert words.startswith(str(peer.url))
    if isinstance(peer, PtyPeer):
        assert words.endswith(" is gone: unplugged"), "whether a read or a write meets it, and however early"


async def test_close_again_and_then_nothing_works(link: Link, peer: Peer) -> None:
    await link.close()
    await link.close()
    assert await lost(link) == f"{peer.url} was closed"
    with pytest.raises(LinkLost, match="closed"):
        await link.write(STOP)


async def test_closed_at_the_same_time_from_two_sides(link: Link, peer: Peer) -> None:
    await asyncio.gather(link.close(), link.close())
    await lost(link)


async def test_close_while_a_read_is_pending(link: Link, peer: Peer) -> None:
    pending = asyncio.create_task(lost(link))
    await asyncio.sleep(0)
    await link.close()
    assert await pending == f"{peer.url} was closed"


async def test_cancelled_read_loses_no_bytes(link: Link, peer: Peer) -> None:
    pending = asyncio.create_task(link.read())
    await asyncio.sleep(0)
    pending.cancel()
    with pytest.raises(asyncio.CancelledError):
        await pending
    peer.send(FRAME)
    assert await read(link, len(FRAME)) == FRAME


async def test_link_reopens_after_every_kind_of_end(peer: Peer) -> None:
    for number in range(6):
        link = await open_link(peer.url)
        peer.send(FRAME) if isinstance(peer, TcpPeer) else None
        await link.write(STOP)
        assert peer.receive(len(STOP)) == STOP
        if number % 2:
            peer.die()
            await lost(link)
            peer.revive()
        await link.close()
        if isinstance(peer, TcpPeer) and not number % 2:
            peer.die()


@pytest.mark.parametrize("peer", ["serial", "tcp"], indirect=True)  # radio has no flow control: test_ble.py
async def test_firehose_into_blocked_loop_is_held_back(link: Link, peer: Peer) -> None:
    """A sender of more bytes than fit must wait. The reader gets all bytes in order."""
    total = 24 * 1024 * 1024 if isinstance(peer, TcpPeer) else 8 * 1024 * 1024
    block = bytes(range(256)) * 256
    sent = 0
    ended = threading.Event()

    def pour() -> None:
        nonlocal sent
        try:
            while sent < total:
                peer.send(block)
                sent += len(block)
        except OSError:
            pass
        ended.set()

    thread = threading.Thread(target=pour)
    thread.start()
    async with asyncio.timeout(PATIENCE_S):
        before = -1
        while before != sent or not sent:  # the sender is blocked
            before = sent
            for _ in range(10):
                await asyncio.sleep(0.01)
    assert sent < total, "held back"
    assert not ended.is_set()
    got = 0
    async with asyncio.timeout(60):
        while got < total:
            data = await link.read()
            assert data[:1] == bytes([got % 256]), "in order"
            got += len(data)
    assert got == total
    await asyncio.to_thread(thread.join)


async def test_car_that_stops_reading_loses_link_not_loop(link: Link, peer: Peer) -> None:

    async def write() -> None:
        await link.write(FRAME * 20)

    peer.stall()
    words = await until_lost(write)
    assert "accepts no bytes" in words or "accepted " in words
    assert await lost(link) == words, "the first cause is kept, and whoever reads is told it"
    with pytest.raises(LinkLost, match=re.escape(words)):
        await link.write(STOP)
    await link.close()


async def test_closing_ends_a_write_that_waits(link: Link, peer: Peer) -> None:
    """A waiting write ends with the link, and no byte follows a half frame."""
    peer.stall()
    writing = asyncio.create_task(until_lost(lambda: link.write(FRAME)))
    for _ in range(5):
        await asyncio.sleep(0)
    await link.close()
    await writing


async def test_frames_from_several_writers_are_never_mixed(link: Link, peer: Peer) -> None:
    frames = [b"$4WD,CLR%d,CLG%d,CLB%d#" % (100 + n, 110 + n, 120 + n) for n in range(20)]
    await asyncio.gather(*(link.write(frame) for frame in frames))
    assert peer.receive(sum(map(len, frames))) == b"".join(frames)


async def test_closed_link_leaves_no_descriptors_or_threads(peer: Peer) -> None:
    await (await open_link(peer.url)).close()  # opens the descriptors that last as long as the loop
    if isinstance(peer, TcpPeer):
        peer.die()
    gc.collect()
    before = open_descriptors()
    for ending in ("close", "die", "die unread", "cancelled") * 5:
        link = await open_link(peer.url)
        pending = asyncio.create_task(link.read())
        await asyncio.sleep(0)
        if ending.startswith("die"):
            peer.send(FRAME)
            peer.die()
        if ending == "die":
            await asyncio.gather(pending, return_exceptions=True)
            await lost(link)
        pending.cancel()
        await asyncio.gather(pending, return_exceptions=True)
        await link.close()
        if ending.startswith("die"):
            peer.revive()
        elif isinstance(peer, TcpPeer):
            peer.die()
        await no_threads()
    del link, pending
    async with asyncio.timeout(PATIENCE_S):
        while len(open_descriptors()) > len(before):
            gc.collect()
            await asyncio.sleep(0.01)


async def test_tcp_reset_is_link_lost(tmp_path: Path) -> None:
    peer = TcpPeer()
    link = await open_link(peer.url)
    peer.send(FRAME[:5])
    assert await read(link, 5) == FRAME[:5]
    peer.reset()
    assert "connection reset" in await lost(link)
    with pytest.raises(LinkLost):
        await link.write(STOP)
    await link.close()
    peer.close()


async def test_write_after_tcp_reset_raises_link_lost() -> None:
    """The loop has not noticed the reset yet, so only the write itself can report it."""
    peer = TcpPeer()
    link = await open_link(peer.url)
    assert peer.peer
    peer.reset()
    with pytest.raises(LinkLost, match=r"is gone: (connection reset|broken pipe)"):
        await link.write(STOP)
    await link.close()
    peer.close()


async def test_blocked_serial_write_does_not_block_loop(tmp_path: Path) -> None:
    """The write of pyserial itself would wait for a write_timeout, or spin.

    The best of several rounds counts, because the machine may be busy.
    """
    peer = PtyPeer(tmp_path)
    stood = []
    for _ in range(5):
        link = await open_link(peer.url)
        began = time.monotonic()
        with contextlib.suppress(LinkLost):
            while True:
                began = time.monotonic()
                await link.write(FRAME)
        stood.append(time.monotonic() - began)
        await link.close()
    assert min(stood) < 0.1
    peer.close()


async def test_write_to_vanishing_port_is_lost_only(tmp_path: Path) -> None:
    """The reader's thread closes a dead port, but never between a write's check of the descriptor and its use."""
    peer = PtyPeer(tmp_path)
    usual = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for _ in range(300):
            link = await open_link(peer.url)
            peer.die()
            for _ in range(20):
                with contextlib.suppress(LinkLost):
                    await link.write(STOP)
            await link.close()
            peer.revive()
    finally:
        sys.setswitchinterval(usual)
    peer.close()


@pytest.mark.parametrize("says", [b"", FRAME])
@pytest.mark.parametrize("reset", [False, True])
async def test_second_client_is_told_of_the_first(says: bytes, reset: bool) -> None:
    """A car has one client. A car that sends bytes and then closes the connection has other reasons."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = await open_link(TcpUrl("127.0.0.1", server.getsockname()[1]))
        peer, _ = server.accept()
        if reset:
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        if says:
            peer.sendall(says)
            assert await read(link, len(says)) == says
        peer.close()
        words = await lost(link)
        assert ("another gateway" in words) == (not says)
        assert ("connection reset" if reset else "closed it") in words
        await link.close()


@pytest.mark.parametrize(
    ("says", "shown"),
    [
        (b"Port already in use\r\n", "Port already in use"),
        (b"  \x1b[2Jbusy\x00\r\ntry later\r\n", "\\x1b[2Jbusy\\x00\\r\\ntry later"),
        ("bereits geöffnet\r\n".encode(), "bereits geöffnet"),
        (b"x" * 5000, "x" * 120 + "..."),
        (b"\r\n", ""),
        (bytes.fromhex("0080E0F8FE") * 5, None),
        (FRAME, None),
        (b'{"v":7.9,"dist_cm":42}\n', None),
    ],
)
async def test_bridge_message_before_close_is_shown(says: bytes, shown: str | None) -> None:
    """A bridge such as ser2net tells a second client why it closes. None: no sentence, so no client of another."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = TcpUrl("127.0.0.1", server.getsockname()[1])
        link = await open_link(url)
        peer, _ = server.accept()
        for piece in (says[:7], says[7:]):
            peer.sendall(piece)
        assert await read(link, len(says)) == says
        peer.close()
        hint = "Perhaps another gateway or program is connected to it."
        said = f', and said "{shown}". {hint}' if shown else ""
        gone = await lost(link)
        assert gone.startswith(f"{url} is gone: ")
        assert gone.endswith(said)
        await link.close()


async def test_frames_do_not_wait_for_tcp_acknowledgement() -> None:
    """A delayed frame would go out in one segment with the next frame. A car obeys only the first of the two."""
    peer = TcpPeer()
    assert isinstance(peer.url, TcpUrl)
    ours = socket.create_connection((peer.url.host, peer.url.port))
    ours.settimeout(0)
    _, link = await asyncio.get_running_loop().create_connection(lambda: TcpLink(TcpUrl("car", 8888)), sock=ours)
    assert ours.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
    assert ours.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
    for _ in range(20):
        await link.write(STOP)
        assert peer.peer.recv(4096) == STOP
    await link.close()
    peer.close()


@pytest.mark.parametrize("peer", [each for each in LINKS if each != "tcp"], indirect=True)  # over TCP, the car refuses
async def test_open_link_is_exclusive(link: Link, peer: Peer) -> None:
    with pytest.raises(Busy, match="in use by "):
        await open_link(peer.url)
    await link.write(STOP)
    assert peer.receive(len(STOP)) == STOP
    await link.close()
    again = await open_link(peer.url)
    await again.close()


async def test_serial_read_does_not_block_loop(tmp_path: Path) -> None:
    """A link has one thread. A read blocks that thread, and never the loop."""
    peer = PtyPeer(tmp_path)
    link = await open_link(peer.url)
    assert [thread.name for thread in link_threads()] == [f"read {peer.url}"]
    pending = asyncio.create_task(link.read())
    for _ in range(100):
        await asyncio.sleep(0)
    assert not pending.done()
    peer.send(b"$")
    assert await pending == b"$"
    await link.close()
    peer.close()


async def test_close_of_stuck_port_discards_unsent_bytes(tmp_path: Path) -> None:
    """A stuck link discards unsent bytes when it closes. Otherwise the port is still full at its next opening.

    Bytes that the other end has taken stay there.
    """
    peer = PtyPeer(tmp_path)
    link = await open_link(peer.url)
    await until_lost(lambda: link.write(FRAME))
    await link.close()
    again = await open_link(peer.url)
    await again.write(STOP)
    came = b""
    while not came.endswith(STOP):
        came += await asyncio.to_thread(peer.receive, 1)
    await again.close()
    peer.close()


async def test_hanging_port_open_uses_one_thread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The test delays pyserial's open, because no device of this machine hangs in opening as a Bluetooth tty can."""
    peer = PtyPeer(tmp_path)
    hangs = threading.Event()
    opening = serial.Serial.open

    def held_up(port: serial.Serial) -> None:
        assert hangs.wait(PATIENCE_S)
        opening(port)

    monkeypatch.setattr(serial.Serial, "open", held_up)
    with pytest.raises(CannotOpen, match=r"within 0.1 s"):
        await open_link(peer.url, timeout_s=0.1)
    for _ in range(3):
        with pytest.raises(CannotOpen, match="still hangs"):
            await open_link(peer.url, timeout_s=0.1)
    threads = link_threads()
    assert len(threads) == 1
    hangs.set()
    await asyncio.to_thread(threads[0].join, PATIENCE_S)
    link = await open_link(peer.url)
    await link.write(STOP)
    assert peer.receive(len(STOP)) == STOP
    await link.close()
    peer.close()
