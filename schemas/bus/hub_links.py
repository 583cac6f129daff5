"""Writes a file with the programs that are connected to a hub, and to the linked hubs of other sites.

`fleet hub show` reads the file. It is only for information: no rule depends on it. The bytes in which the hub of a site
lists its links are checked like any other bytes from outside.
"""

import contextlib
import json
import threading
from typing import Any, Final

import zenoh

from schemas.atomic_file import write_atomically
from schemas.bus.credentials import HUB, Credentials
from schemas.identity import IdentityRole
from schemas.keys import is_name

LINKS_FILE: Final = "links.json"
"""File with the addresses from which each common name is connected. The name of another site follows its addresses."""
SITE_LINKS_S: Final = 10.0
"""Time for which the links of a site count. Its hub sends them every two seconds."""
MAX_SITE_LINKS_BYTES: Final = 65_536
MAX_SITES: Final = 64
_MAX_TEXT: Final = 100
_SITE_HUB: Final = f"{IdentityRole.SITE}."

Links = dict[str, list[str]]
"""Addresses by common name."""


class HubLinks:
    """The links of one hub with certificates, and the links that the hubs of other sites have sent to it."""

    def __init__(self, credentials: Credentials) -> None:
        self.credentials = credentials
        self._own: Links = {}
        self._of_sites: dict[str, tuple[Links, float]] = {}
        self._lock = threading.Lock()
        self._written: Links | None = None

    def of_this_site(self) -> bytes:
        """Return the links that the hub of a site sends to the first hub. Empty if it has no name or too many links."""
        site = self.credentials.site
        links = {name: each for name, each in self._own.items() if name != HUB and not name.startswith(_SITE_HUB)}
        told = json.dumps({"site": site, "links": links}).encode() if site else b""
        return told if len(told) <= MAX_SITE_LINKS_BYTES else b""

    def take(self, told: bytes, now: float) -> None:
        """Store the links that the hub of a site has sent. Ignore other bytes. Runs on a Zenoh thread."""
        found = parse_site_links(told)
        if found is None:
            return
        with self._lock:
            self._forget_old(now)
            if found[0] in self._of_sites or len(self._of_sites) < MAX_SITES:
                self._of_sites[found[0]] = found[1], now

    def _forget_old(self, now: float) -> None:
        self._of_sites = {site: each for site, each in self._of_sites.items() if now < each[1] + SITE_LINKS_S}

    def write(self, own: Links, now: float) -> None:
        """Write the links of this hub and of the other sites to the file, if they have changed.

        The links of a site count only while its hub is linked to this one.
        """
        self._own = {name: sorted(addresses) for name, addresses in sorted(own.items())}
        linked = {name.split(".")[1] for name in own if name.startswith(_SITE_HUB)}
        links = {name: list(addresses) for name, addresses in self._own.items()}
        with self._lock:
            self._forget_old(now)
            for site, (there, _) in sorted(self._of_sites.items()):
                for name, addresses in there.items() if site in linked else ():
                    links.setdefault(name, []).extend(f"{each} ({site})" for each in addresses)
        if links != self._written:
            self._written = links
            with contextlib.suppress(OSError):  # the file is only for information
                write_atomically(self.credentials.directory / LINKS_FILE, json.dumps(links).encode(), private=True)


def links_of(session: zenoh.Session) -> Links:
    """Return the links of a router with certificates."""
    found: Links = {}
    for link in session.info.links():
        if link.auth_identifier:
            found.setdefault(link.auth_identifier, []).append(link.dst.partition("/")[2])
    return found


def parse_site_links(told: bytes) -> tuple[str, Links] | None:
    """Return the name of a site and its links, or None if these bytes are something else."""
    if not told or len(told) > MAX_SITE_LINKS_BYTES:
        return None
    try:
        found = json.loads(told)
        site, links = found["site"], found["links"]
        if not (isinstance(site, str) and is_name(site) and isinstance(links, dict)):
            return None
        return site, {name: list(each) for name, each in links.items() if _is_text(name) and all(map(_is_text, each))}
    except (ValueError, KeyError, TypeError, RecursionError):
        return None


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= _MAX_TEXT and value.isascii() and value.isprintable()
