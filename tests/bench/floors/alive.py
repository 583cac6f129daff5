"""Floor: a process that opens a session and declares a token. Arguments: endpoint, token."""

import sys
import threading

from client import opened

endpoint, key = sys.argv[1:]
with opened(endpoint) as session:
    token = session.liveliness().declare_token(key)
    threading.Event().wait()
