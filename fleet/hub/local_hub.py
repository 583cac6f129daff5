"""Makes this computer a hub, lets it join the hub on another computer, and lets it leave that hub."""

import getpass
import os
import re
import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from fleet.hub.addresses import own_addresses, own_names
from fleet.hub.hub_store import HubStore
from fleet.hub.join import Joined, NotJoined
from schemas import identity
from schemas.atomic_file import write_atomically
from schemas.bus import LOOPBACK, is_secure
from schemas.bus.credentials import CA_FILE, DIRECTORY, HUB, ME_FILE, Credentials
from schemas.identity import IdentityRole, Service, role_of
from schemas.keys import is_name
from schemas.state_dir import JOINED_FILE, STATE_VARIABLE, default_directory, directory_of, joined_endpoint

SECURE_ENDPOINT: Final = f"tls/{LOOPBACK}:7447"
"""Endpoint at which programs on the hub's own computer find the hub."""
JOINED_BYTES: Final = 65_536
"""Size of a test file. A joining computer stores less: a key, two certificates, and at a site the rules of twenty
identities."""
SOMEBODY: Final = "operator"
"""The name of a user whose login is not valid as a person's name."""


def local_person() -> str:
    """Return the name of the user of this computer: FLEET_AS, or the login."""
    given = os.environ.get("FLEET_AS", "")
    try:
        name = given or getpass.getuser()
    except (KeyError, OSError, ImportError):  # no entry for this user id, as in some containers
        name = SOMEBODY
    name = re.sub(r"[^a-z0-9_-]+", "-", name.lower()).strip("-_")[:32]
    return name if is_name(name) else SOMEBODY


def ensure_hub_here(
    endpoint: str, cars: Iterable[str] = (), *, listens: Iterable[str] = (), take: Iterable[str] = ()
) -> HubStore:
    """Make this computer the hub at `endpoint`, or bring its certificates up to date. Raises BusError, OSError.

    cars: cars whose gateways run on this computer, unless another computer has their certificates. take: identities
    that this computer gets even if another computer has their certificates.
    """
    store = HubStore.of(endpoint)
    name = identity.parse(store.credentials.me)
    me = store.credentials.me if name is not None else identity.person(local_person())
    wanted = [*map(identity.car, cars), *map(identity.service, Service)]
    addresses = (*own_addresses(), *own_names())
    store.ensure(wanted, me, addresses=addresses, listens=listens, take=take)
    use(endpoint)
    return store


def everywhere(endpoint: str) -> str:
    """Return the endpoint at which a hub listens if other computers may join it."""
    return f"{endpoint.partition('/')[0]}/0.0.0.0:{endpoint.rpartition(':')[2]}"


def is_hub_here(endpoint: str) -> bool:
    """Return True if this computer is the hub with certificates at `endpoint`."""
    return is_secure(endpoint) and HubStore(Credentials.of(endpoint)).is_hub


def is_authority_here(ca: bytes) -> bool:
    """Return True if this computer has the key of the authority with this certificate. Then it is the hub."""
    found = directory_of(SECURE_ENDPOINT).parent.glob(f"*/{DIRECTORY}/{CA_FILE}")
    return any(each.read_bytes() == ca and HubStore(Credentials(each.parent, "")).is_hub for each in found)


def use(endpoint: str) -> None:
    """Make `endpoint` the default of every program of this user. Raises OSError."""
    directory = default_directory()
    directory.mkdir(parents=True, exist_ok=True)
    write_atomically(directory / JOINED_FILE, f"{endpoint}\n".encode())


def check_storage(host: str, port: int = 0) -> None:
    """Raise NotJoined if this computer cannot store what it gets when it joins. Call this before a code is used up.

    host: the host of the hub that this computer will use. Empty if it must be found first. port: the port of that hub,
    if it is known.
    """
    default = int(SECURE_ENDPOINT.rpartition(":")[2])
    endpoint = f"tls/{host}:{port or default}"
    for place in (default_directory(), Credentials.of(endpoint).directory if host else directory_of(endpoint).parent):
        _check_writable(place)


def _check_writable(place: Path) -> None:
    """Write a file to a directory, or where it would be made, and remove it again. Raises NotJoined."""
    try:
        place = next(each for each in (place, *place.parents) if each.exists() or each.is_symlink())
        with tempfile.TemporaryFile(dir=place) as probe:
            probe.write(bytes(JOINED_BYTES))
            probe.flush()
            os.fsync(probe.fileno())
    except OSError as error:
        raise NotJoined(
            f"{place}: {error.strerror}. A certificate must be stored there. The code was not sent, and is still good: "
            f"make this a directory that you may write, with free space, or set {STATE_VARIABLE} to another one."
        ) from None


def store_joined(host: str, joined: Joined, site: str = "", site_port: int = 0) -> str:
    """Store what this computer got when it joined, and return the endpoint of its hub. Raises OSError, NotJoined.

    A computer may join again. For a car or a service, its user then stays the same person. `site` is the address
    of the hub to use, if it is not the hub that was joined. site_port: the port of that hub, if it differs.
    """
    first = f"tls/{host}:{joined.port}"
    at = LOOPBACK if joined.rules else site or host
    endpoint = f"tls/{at}:{site_port or joined.port}"
    if is_hub_here(endpoint):
        raise NotJoined(f"this computer is the hub at {endpoint}: its user is {Credentials.of(endpoint).me}")
    credentials = Credentials.of(endpoint)
    directory = credentials.directory
    directory.mkdir(parents=True, exist_ok=True)
    os.chmod(directory, 0o700)  # noqa: PTH101 - a private directory
    name = HUB if joined.rules else joined.identity
    files = {CA_FILE: joined.ca, f"{name}.key": joined.key, f"{name}.pem": joined.certificate}
    if not joined.rules and (
        role_of(joined.identity) is IdentityRole.PERSON or role_of(credentials.me) is not IdentityRole.PERSON
    ):
        files[ME_FILE] = joined.identity.encode()
    for name, data in files.items():
        write_atomically(directory / name, data, sync=True, private=True)
    if joined.rules:
        name_of_site = joined.identity.partition(".")[2]
        credentials.store_site(name_of_site, [everywhere(endpoint)], [first], joined.rules)
    use(endpoint)
    return endpoint


def leave() -> tuple[str, Path | None]:
    """End the use of a joined hub.

    Return its endpoint (empty if there is none), and the directory of a hub's authority if that was kept.

    Raises OSError.
    """
    endpoint = joined_endpoint()
    if not endpoint:
        return "", None
    (default_directory() / JOINED_FILE).unlink(missing_ok=True)
    directory = Credentials.of(endpoint).directory
    if is_hub_here(endpoint):
        return endpoint, directory
    shutil.rmtree(directory, ignore_errors=True)
    return endpoint, None
