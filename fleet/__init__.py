"""Several cars from one laptop: drive, watch, record and replay them.

`from fleet import Fleet` is the SDK, and `from fleet.aio import Fleet` its asyncio twin. A `Session` is one recording.
A `Catalog` answers questions about all recordings.
"""

# Do not import TYPE_CHECKING (below) from `typing`: that would take longer than all the rest of this module. The
# `fleet` command handles Ctrl-C only after this module is imported.
from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Final

    from fleet.client.client import Fleet as Fleet
    from fleet.client.outcome import LeaseLost as LeaseLost
    from fleet.client.outcome import NotCarriedOut as NotCarriedOut
    from fleet.client.outcome import Outcome as Outcome
    from fleet.client.reading import Reading as Reading
    from fleet.recording.catalog import Catalog as Catalog
    from fleet.recording.reading.session import Session as Session

_HOME: Final = {
    "Catalog": "fleet.recording.catalog",
    "Fleet": "fleet.client.client",
    "LeaseLost": "fleet.client.outcome",
    "NotCarriedOut": "fleet.client.outcome",
    "Outcome": "fleet.client.outcome",
    "Reading": "fleet.client.reading",
    "Session": "fleet.recording.reading.session",
}


def __getattr__(name: str) -> object:
    """Import a name on first use, so that commands which do not need it start fast."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)
