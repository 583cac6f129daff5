"""Floor: a process answers queries at once. Arguments: endpoint, key, and key expressions of tokens to watch."""

import sys
import threading

import zenoh
from client import opened


def answer(query: zenoh.Query) -> None:
    with query:
        query.reply(key, b"here", express=True)


endpoint, key, *watched = sys.argv[1:]
with opened(endpoint) as session:
    watches = [session.liveliness().declare_subscriber(each, lambda _: None, history=True) for each in watched]
    queryable = session.declare_queryable(key, answer)
    token = session.liveliness().declare_token(f"{key}/alive")
    threading.Event().wait()
