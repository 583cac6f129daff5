"""Several cars from one laptop: drive, watch, record and replay them.

`from fleet import Fleet`; its twin for asyncio is `from fleet.aio import Fleet`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from fleet.client import Fleet as Fleet
    from fleet.outcome import LeaseLost as LeaseLost
    from fleet.outcome import NotCarriedOut as NotCarriedOut
    from fleet.outcome import Outcome as Outcome
    from fleet.readings import Reading as Reading

_HOME: Final = {
    "Fleet": "fleet.client",
    "LeaseLost": "fleet.outcome",
    "NotCarriedOut": "fleet.outcome",
    "Outcome": "fleet.outcome",
    "Reading": "fleet.readings",
}


def __getattr__(name: str) -> object:
    """Imported when it is first asked for: no command line waits for what it does not use."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)
