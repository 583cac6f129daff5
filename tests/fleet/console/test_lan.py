"""The listening socket of the network side."""

import socket
from contextlib import ExitStack

from fleet.console.lan import LimitedListener


def test_connections_that_wait_are_accepted_one_for_each_turn_of_the_loop() -> None:
    """The loop calls `accept` until it raises BlockingIOError, and so ends its turn."""
    with ExitStack() as opened:
        listener = opened.enter_context(LimitedListener.on_port(0))
        for _ in range(3):
            opened.enter_context(socket.create_connection(("127.0.0.1", listener.getsockname()[1])))
        turns = []
        for _ in range(3):
            accepted = 0
            try:
                while True:
                    opened.enter_context(listener.accept()[0])
                    accepted += 1
            except BlockingIOError:
                turns.append(accepted)
    assert turns == [1, 1, 1]
