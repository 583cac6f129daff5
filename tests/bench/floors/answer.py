"""Floor: a query is answered at once. Arguments: endpoint, key."""

import sys
import threading

import zenoh
from client import opened


def answer(query: zenoh.Query) -> None:
    with query:
        query.reply(key, b"here", express=True)


endpoint, key = sys.argv[1:]
with opened(endpoint) as session:
    queryable = session.declare_queryable(key, answer)
    token = session.liveliness().declare_token(f"{key}/alive")
    threading.Event().wait()
