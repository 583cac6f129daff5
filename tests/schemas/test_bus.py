"""The bus on real Zenoh sessions: hub, publications, queries, tokens, and behavior without a hub."""

import asyncio
import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from schemas import bus, messages, topics
from schemas.bus import zenoh_session
from schemas.bus.zenoh_session import LINK_TIMEOUT_S
from schemas.gen import fleet_v1_pb2 as pb
from tests.support import processes
from tests.support.ports import free_endpoint
from tests.support.tcp_proxy import StallProxy, TcpProxy


def wait_for(condition: Callable[[], object]) -> None:
    """Poll until a condition holds. Zenoh's callbacks may come at any time."""
    processes.wait_for(condition, "what is waited for on the bus")


@pytest.fixture
def endpoint() -> Iterator[str]:
    where = free_endpoint()
    hub = subprocess.Popen([sys.executable, "-m", "schemas.bus.hub", "--endpoint", where])
    wait_for(lambda: bus.accepts(where))
    yield where
    hub.terminate()
    assert hub.wait(processes.PATIENCE_S) == 0


def test_publication_has_header_seq_encoding_and_time(endpoint: str) -> None:
    with bus.Bus.open(endpoint) as sender, bus.Bus.open(endpoint) as receiver:
        got: list[bus.Sample] = []
        receiver.subscribe("fleet/**", got.append)
        publisher = sender.publisher("fleet/red/sensor/range", topics.TOPICS["sensor/range"], "red")
        before = time.time_ns()

        def put() -> bool:
            publisher.put(pb.Range(range_m=1.25), stamp_ns=1_500_000_000)
            return bool(got)

        wait_for(put)
        sample = got[-1]
        message = sample.message()
        assert isinstance(message, pb.Range)
        assert (message.car, message.boot_id, message.range_m) == ("red", sender.boot_id, 1.25)
        assert (message.stamp.seconds, message.stamp.nanos) == (1, 500_000_000)
        assert message.seq == sample.sequence
        assert sample.encoding == "application/protobuf;fleet.v1.Range"
        assert before <= sample.time_ns <= time.time_ns() + 1_000_000_000


def test_query_reaches_everyone_and_commands_match_no_wildcard(endpoint: str) -> None:
    with bus.Bus.open(endpoint) as one, bus.Bus.open(endpoint) as two, bus.Bus.open(endpoint) as asker:
        asked: list[str] = []

        def answer(name: str) -> Callable[..., None]:
            def take(query: object) -> None:
                with query:  # type: ignore[attr-defined]
                    bus.reply(query, f"fleet/{name}/state/link", name.encode(), "text/plain")  # type: ignore[arg-type]

            return take

        one.queryable("fleet/red/state/*", answer("red"))
        two.queryable("fleet/blue/state/*", answer("blue"))
        one.queryable("fleet/red/@cmd/*", lambda query: asked.append(str(query)))

        def both() -> bool:
            found = list(asker.query("fleet/*/state/*", timeout_s=10.0))
            return sorted(each.payload for each in found if isinstance(each, bus.Sample)) == [b"blue", b"red"]

        wait_for(both)
        assert len(list(asker.query("fleet/**", timeout_s=10.0))) == 2
        assert asked == []


def test_tokens_come_and_go(endpoint: str) -> None:
    with bus.Bus.open(endpoint) as watcher:
        seen: list[tuple[str, bool]] = []
        watcher.watch_tokens("fleet/*", lambda key, alive: seen.append((key, alive)))
        with bus.Bus.open(endpoint) as car:
            car.token("fleet/red")
            wait_for(lambda: seen == [("fleet/red", True)])
            assert watcher.tokens("fleet/*") == ["fleet/red"]
        wait_for(lambda: seen == [("fleet/red", True), ("fleet/red", False)])
        assert watcher.tokens("fleet/*") == []


def test_ctrl_c_does_not_interrupt_a_declaration(endpoint: str) -> None:
    declared: list[bool] = []

    def declare(*_: object) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        threading.Event().wait(0.2)  # the main thread handles the signal meanwhile
        declared.append(True)

    with bus.Bus.open(endpoint) as opened:
        with pytest.raises(KeyboardInterrupt):
            opened._declare(declare)
        assert declared == [True]


def test_token_watch_sees_all_present_tokens(endpoint: str) -> None:
    """Zenoh answers a watcher's query with the tokens that have arrived, so a coordinator once saw no car."""
    there = {"fleet/red", "fleet/green", "fleet/blue"}
    with bus.Bus.open(endpoint) as cars:
        for token in there:
            cars.token(token)
        with bus.Bus.open(endpoint) as other:
            wait_for(lambda: set(other.tokens("fleet/*")) == there)
        for _ in range(40):
            before = cars._link.address
            with bus.Bus.open(endpoint) as watcher, ThreadPoolExecutor(3) as pool:
                watcher.watch_tokens("fleet/*", lambda key, alive: None)
                asked = [pool.submit(watcher.tokens, "fleet/*") for _ in range(9)]
                answers = [set(each.result()) for each in asked]
            assert all(each == there for each in answers) or cars._link.address != before


THERE = ["fleet/red", "two/red"]
"""Tokens of two fleets. A watcher watches those of the first one."""


@contextlib.contextmanager
def watcher_behind(proxy: TcpProxy, endpoint: str) -> Iterator[bus.Bus]:
    """Open a session whose link goes through a proxy. The tokens of THERE exist while it is open."""
    with bus.Bus.open(endpoint) as cars, bus.Bus.open(f"tcp/127.0.0.1:{proxy.port}") as watcher:
        for token in THERE:
            cars.token(token)
        wait_for(lambda: watcher.tokens("*/*") == THERE)
        watcher.watch_tokens("fleet/*", lambda key, alive: None)
        yield watcher
    proxy.close()


def test_tokens_after_a_lost_link(endpoint: str) -> None:
    """A session without a link got an empty answer at once, and then one without the tokens that it watched."""
    proxy = StallProxy(int(endpoint.rpartition(":")[2]))
    with watcher_behind(proxy, endpoint) as watcher:
        proxy.cut()
        wait_for(lambda: not watcher.connected)
        proxy.mend()
        began = time.monotonic()
        while (found := watcher.tokens("*/*")) == [] and time.monotonic() > began + LINK_TIMEOUT_S:
            began = time.monotonic()  # it waited for the link: a stalled machine takes longer to open one
        assert found == THERE
        assert watcher.tokens("fleet/*") == ["fleet/red"]


def test_tokens_of_closed_session_are_refused_at_once(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It waited 2 s for a link, without a pause."""
    monkeypatch.setattr(zenoh_session, "LINK_TIMEOUT_S", 10 * processes.PATIENCE_S)
    with bus.Bus.open(endpoint) as closed:
        pass
    with pytest.raises(bus.BusError, match="closed"):
        closed.tokens("*/*", 10 * processes.PATIENCE_S)


def test_tokens_do_not_wait_for_callbacks(endpoint: str) -> None:
    """On a busy machine, a callback ran after the answer over a new link. Then that answer lacked watched tokens."""
    proxy = TcpProxy(int(endpoint.rpartition(":")[2]))
    busy, called = threading.Event(), threading.Event()
    with watcher_behind(proxy, endpoint) as watcher:
        watcher.watch_tokens("two/*", lambda key, alive: called.set() if alive else busy.wait(processes.PATIENCE_S))
        called.clear()
        before = listed_link(watcher)
        proxy.hang_up()
        wait_for(lambda: listed_link(watcher) not in ("", before))
        assert watcher.tokens("*/*") == THERE
        assert watcher.tokens("two/*") == ["two/red"]
        assert not called.is_set()
        busy.set()
        wait_for(called.is_set)


def test_error_of_a_callback_ends_no_other_watch(endpoint: str) -> None:
    hook, errors, seen = threading.excepthook, [], list[str]()
    threading.excepthook = lambda failed: errors.append(failed.exc_type)
    try:
        with bus.Bus.open(endpoint) as car, bus.Bus.open(endpoint) as watcher:
            watcher.watch_tokens("fleet/*", lambda key, alive: 1 // 0)
            watcher.watch_tokens("two/*", lambda key, alive: seen.append(key))
            car.token("fleet/red")
            car.token("two/red")
            wait_for(lambda: seen == ["two/red"])
            wait_for(lambda: errors == [ZeroDivisionError])
    finally:
        threading.excepthook = hook


def test_callback_may_declare_a_watch(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It waited for its own thread to report the tokens of that watch, and no other callback ran meanwhile."""
    monkeypatch.setattr(zenoh_session, "_TOKEN_HISTORY_TIMEOUT_S", 2 * processes.PATIENCE_S)
    with bus.Bus.open(endpoint) as cars, bus.Bus.open(endpoint) as watcher:
        seen: list[str] = []
        for token in THERE:
            cars.token(token)
        wait_for(lambda: watcher.tokens("*/*") == THERE)
        began = time.monotonic()
        watcher.watch_tokens("fleet/*", lambda *_: watcher.watch_tokens("two/*", lambda key, alive: seen.append(key)))
        wait_for(lambda: seen == ["two/red"])
        assert time.monotonic() < began + processes.PATIENCE_S
        assert watcher.tokens("two/*") == ["two/red"]


def listed_link(opened: bus.Bus) -> str:
    return next((str(link.src) for link in opened._session.info.links()), "")


def test_tokens_while_link_ends_and_next_one_opens(endpoint: str) -> None:
    """Zenoh lists a link some time before and after it carries messages. Asked then, it knew no token, or only some."""
    proxy = TcpProxy(int(endpoint.rpartition(":")[2]))
    with watcher_behind(proxy, endpoint) as watcher:
        for _ in range(20):
            before = listed_link(watcher)
            proxy.hang_up()
            deadline = time.monotonic() + processes.PATIENCE_S
            while listed_link(watcher) in ("", before):  # without a pause, to see the next link as soon as it is listed
                assert time.monotonic() < deadline
            assert watcher.tokens("*/*") == THERE
            proxy.hang_up()
            assert watcher.tokens("*/*") == THERE


def test_each_link_has_a_text_of_its_own(endpoint: str) -> None:
    proxy = TcpProxy(int(endpoint.rpartition(":")[2]))
    with watcher_behind(proxy, endpoint) as watcher:
        links = [watcher.link]
        for _ in range(3):
            proxy.hang_up()
            wait_for(lambda: watcher.link not in ("", *links))
            links.append(watcher.link)
    assert all(links)
    assert watcher.link == "", "it is closed"


def test_tokens_of_all_fleets_while_watching_one(endpoint: str) -> None:
    """Zenoh leaves watched tokens out of some answers, so one of two fleets was not there, and a stop missed it."""
    there = {"fleet/red", "two/red"}
    with bus.Bus.open(endpoint) as cars:
        for token in there:
            cars.token(token)
        with bus.Bus.open(endpoint) as other:
            wait_for(lambda: set(other.tokens("*/*")) == there)
        for _ in range(150):
            before = cars._link.address
            with bus.Bus.open(endpoint) as watcher:
                watcher.watch_tokens("fleet/*", lambda key, alive: None)
                every, second = set(watcher.tokens("*/*")), watcher.tokens("two/*")
            # Otherwise the machine stalled for over 2 s, and the hub forgot the tokens meanwhile.
            if cars._link.address == before:
                assert every == there
                assert second == ["two/red"]


def test_hub_is_started_once_and_ends_when_idle() -> None:
    where = free_endpoint()
    idle = subprocess.Popen([sys.executable, "-m", "schemas.bus.hub", "--endpoint", where, "--idle-s", "3"])
    wait_for(lambda: bus.accepts(where))
    with bus.Bus.open(where, start_hub=True) as opened:  # the session must not end while the second one starts
        assert opened.connected
        second = subprocess.run(
            [sys.executable, "-m", "schemas.bus.hub", "--endpoint", where],
            capture_output=True,
            text=True,
            timeout=processes.PATIENCE_S,
            check=False,
        )
        assert second.returncode == 1
        assert "cannot listen" in second.stderr
    assert idle.wait(processes.PATIENCE_S) == 0


@pytest.mark.parametrize(
    ("host", "loopback"),
    [("127.0.0.1", True), ("127.1.2.3", True), ("localhost", True), ("[::1]", True)]
    + [(host, False) for host in ("0.0.0.0", "192.168.1.5", "[::]", "127.0.0.1.example.org", "laptop.local")],
)
def test_hub_listens_on_network_only_on_request(host: str, loopback: bool) -> None:
    where = f"tcp/{host}:7447"
    assert bus.is_loopback(where) is loopback
    bus.check_listening(where, insecure_lan=True)
    if loopback:
        bus.check_listening(where, insecure_lan=False)
    else:
        with pytest.raises(bus.BadEndpoint, match="would let everyone on that network drive the cars"):
            bus.check_listening(where, insecure_lan=False)


def test_hub_on_network_is_wrong_use() -> None:
    command = [sys.executable, "-m", "schemas.bus.hub", "--endpoint", "tcp/0.0.0.0:7447"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=processes.PATIENCE_S, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("hub: a hub at tcp/0.0.0.0:7447 would let everyone")


def test_sessions_reconnect_to_restarted_hub() -> None:
    where = free_endpoint()
    with bus.Bus.open(where, start_hub=True) as car, bus.Bus.open(where) as watcher:
        car.token("fleet/red")
        wait_for(lambda: watcher.tokens("fleet/*") == ["fleet/red"])
        found = subprocess.run(
            ["pgrep", "-f", f"schemas.bus.hub --endpoint {where}"], capture_output=True, text=True, check=True
        )
        os.kill(int(found.stdout), signal.SIGKILL)
        wait_for(lambda: not car.connected)
        wait_for(lambda: not bus.accepts(where))  # a killed process closes its links before its listening port
        bus.ensure_hub(where)
        wait_for(lambda: watcher.tokens("fleet/*") == ["fleet/red"])
        found = subprocess.run(
            ["pgrep", "-f", f"schemas.bus.hub --endpoint {where}"], capture_output=True, text=True, check=True
        )
    os.kill(int(found.stdout), signal.SIGTERM)


def test_without_a_hub_whoever_only_asks_is_told_so() -> None:
    where = free_endpoint()
    with pytest.raises(bus.NoFleet, match=rf"Nothing is running yet.*{where}"):
        bus.Bus.open(where)


def test_hub_of_another_computer_that_does_not_answer_is_not_an_idle_fleet() -> None:
    where = free_endpoint().replace("127.0.0.1", "0.0.0.0")  # no loopback address by its name
    with pytest.raises(bus.HubUnreachable, match=rf"Nothing answers at {where}"):
        bus.Bus.open(where)


def test_foreign_listener_is_named_as_no_router() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        where = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(bus.BusError, match="Zenoh router"):
            bus.Bus.open(where, timeout_s=1.0)


@pytest.mark.parametrize(
    "bad", ["127.0.0.1:7447", "tcp/127.0.0.1", "tcp/host:0", "tcp/host:65536", "http/host:80", "tcp/:7447", "tcp/a b:c"]
)
def test_bad_endpoints_are_wrong_use(bad: str) -> None:
    with pytest.raises(bus.BadEndpoint, match="write it as tcp/HOST:PORT"):
        bus.resolve_endpoint(bad)


def test_resolve_endpoint_prefers_argument_then_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FLEET_ENDPOINT", raising=False)
    assert bus.resolve_endpoint() == "tcp/127.0.0.1:7447"
    monkeypatch.setenv("FLEET_ENDPOINT", "tcp/[::1]:7000")
    assert bus.resolve_endpoint() == "tcp/[::1]:7000"
    assert bus.resolve_endpoint("tls/box:7447") == "tls/box:7447"
    monkeypatch.setenv("FLEET_ENDPOINT", "box:7447")
    with pytest.raises(bus.BadEndpoint, match=r"^FLEET_ENDPOINT: endpoint 'box:7447' is not allowed"):
        bus.resolve_endpoint()


async def turns() -> None:
    """Let the loop run all ready callbacks, and the callbacks that these add."""
    for _ in range(4):
        await asyncio.sleep(0)


async def test_handover_keeps_order_bounded_and_counts_drops() -> None:
    taken: list[int] = []
    handover = bus.Handover(asyncio.get_running_loop(), taken.append, limit=10)
    thread = threading.Thread(target=lambda: [handover(number) for number in range(25)])
    thread.start()
    thread.join()  # the loop cannot run meanwhile: the queue fills
    assert handover.dropped == 15
    await turns()
    assert taken == list(range(10))
    assert handover(99)
    await turns()
    assert taken == [*range(10), 99]


async def test_handover_lets_other_handovers_have_turns() -> None:
    """With two full handovers, the second one used to wait until the first one was empty."""
    taken: list[str] = []
    loop = asyncio.get_running_loop()
    many: bus.Handover[str] = bus.Handover(loop, taken.append, limit=1000)
    one: bus.Handover[str] = bus.Handover(loop, taken.append)
    thread = threading.Thread(target=lambda: [*(many("drive") for _ in range(1000)), one("stop")])
    thread.start()
    thread.join()
    for _ in range(200):
        await asyncio.sleep(0)
    assert len(taken) == 1001
    assert taken.index("stop") < 50


async def test_backlog_takes_one_at_a_time_and_refuses_overflow() -> None:
    backlog: bus.Backlog[int] = bus.Backlog(3)
    assert [backlog(number) for number in range(2)] == [True, True], "before there is a loop"
    backlog.attach(asyncio.get_running_loop(), asyncio.Event())
    assert [backlog(number) for number in range(2, 5)] == [True, False, False]
    assert [await backlog.next() for _ in range(3)] == [0, 1, 2]
    assert backlog.dropped == 2
    thread = threading.Timer(0.01, backlog, (7,))
    thread.start()
    assert await backlog.next() == 7
    thread.join()


async def test_latest_coalesces_values_by_name() -> None:
    batches: list[dict[str, bool]] = []
    latest: bus.Latest[bool] = bus.Latest(limit=3)
    latest("early", True)
    latest.attach(asyncio.get_running_loop(), batches.append)
    await turns()
    assert batches == [{"early": True}]
    for number in range(100):
        assert latest("ann", number % 2 == 0)
    assert latest("bob", True)
    assert latest("early", False)
    assert not latest("eve", True), "there is no room for more names"
    await asyncio.sleep(2 * latest.INTERVAL_S)
    assert batches[1:] == [{"ann": False, "bob": True, "early": False}]
    assert latest.dropped == 1


async def test_newest_handover_drops_oldest_values() -> None:
    taken: list[int] = []
    handover = bus.Handover(asyncio.get_running_loop(), taken.append, limit=10, newest=True)
    thread = threading.Thread(target=lambda: [handover(number) for number in range(25)])
    thread.start()
    thread.join()
    assert handover.dropped == 15
    await turns()
    assert taken == list(range(15, 25))


def test_json_reply_is_protobuf_mapping() -> None:
    text = messages.to_json(pb.Line(car="red", left_inner=True, seq=7))
    assert '"left_inner":true' in text
    assert '"seq":"7"' in text


def test_message_has_type_of_key_and_foreign_answers_are_skipped() -> None:
    def answer(
        message: pb.Safety | pb.Plan, payload: bytes | None = None, key: str = "fleet/red/state/safety"
    ) -> bus.Sample:
        data = message.SerializeToString() if payload is None else payload
        return bus.Sample(key, data, messages.encoding_of(message.DESCRIPTOR.full_name), 1, 1)

    ours, other = pb.Safety(car="red"), pb.Plan(text="x")
    answers: list[bus.Sample | bus.Failure] = [
        bus.Failure("busy"),
        answer(other),
        answer(ours, b"\xff"),
        answer(ours),
        answer(other, key="fleet/red/mine"),
    ]
    assert list(bus.messages_of(answers)) == [ours, other], "a key without a topic takes any message"
    with pytest.raises(messages.BadPayload, match=r"is a fleet.v1.Plan, this key takes fleet.v1.Safety"):
        answer(other).message()
