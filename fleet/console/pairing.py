"""Who may open the console from the network: pairing codes, paired devices and their people. Pure.

Times are seconds since the epoch, since the book outlives the process.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PagePerson:
    """The person at a page. Pages of this computer have the console's own name."""

    name: str
    rank: str = "person"
    """`person` or `lead`."""
