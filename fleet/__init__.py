"""Several cars from one laptop: drive, watch, record and replay them.

`from fleet import Fleet`; its twin for asyncio is `from fleet.aio import Fleet`.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fleet.client import Fleet as Fleet


def __getattr__(name: str) -> object:
    """Fleet, when it is first asked for: no command line waits for what it does not use."""
    if name == "Fleet":
        from fleet.client import Fleet

        return Fleet
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
