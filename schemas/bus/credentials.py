"""The certificates and rules of a hub with TLS, as files in the state directory. `fleet.hub` makes them.

Each process of ours connects with a certificate. Its common name is an identity such as `person.mia`, `car.red` or
`service.recorder` (schemas/identity.py). The rules of the hub say which keys an identity may use. A command has the
identity of its sender in its key, so a gateway knows who sent it.
"""

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

from schemas.atomic_file import write_atomically
from schemas.bus.certificate_dates import CertificateDates
from schemas.bus.errors import BusError
from schemas.identity import AS_THE_USER, IdentityRole
from schemas.state_dir import directory_of

DIRECTORY: Final = "tls"
"""Directory in the state directory of a bus."""
CA_FILE: Final = "ca.pem"
ME_FILE: Final = "me"
"""File with the identity of whoever uses this computer."""
HUB: Final = "hub"
"""Name of the hub's certificate."""
HUB_FILE: Final = "hub.json"
"""File with the addresses on which the hub listens, and its rules. At another site, it also has the address of the
first hub and the name of the site; at the first hub, it also has the rules for the hubs of the other sites."""
LISTEN: Final = "listen"
ACCESS_CONTROL: Final = "access_control"
CONNECT: Final = "connect"
OF_SITES: Final = "access_control_of_sites"
SITE: Final = "site"


class NoCredentials(BusError):
    """This computer has no certificate, or no rules, for a hub. The text says how to get them."""


class Credentials(NamedTuple):
    """The files for one hub."""

    directory: Path
    endpoint: str

    @classmethod
    def of(cls, endpoint: str) -> Self:
        """Return the files for a hub, which may not exist."""
        return cls(directory_of(endpoint) / DIRECTORY, endpoint)

    @property
    def exist(self) -> bool:
        """Return True if the certificate of the hub's authority is here."""
        return (self.directory / CA_FILE).is_file()

    @property
    def me(self) -> str:
        """Return the identity of whoever uses this computer, or an empty text if there is none."""
        try:
            return (self.directory / ME_FILE).read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError):
            return ""

    def identity(self, wanted: str = "") -> str:
        """Return the wanted identity, by default that of the user, if its certificate is here. Raises NoCredentials.

        Only the services of AS_THE_USER may use the certificate of the user instead. For any other, never use another
        certificate: the hub would drop the messages of such a gateway without an error.
        """
        names = (wanted, self.me) if wanted in AS_THE_USER else (wanted or self.me,)
        for name in names:
            if name and (self.directory / f"{name}.pem").is_file():
                return name
        role, _, own = (wanted or "person.NAME").partition(".")
        option = "" if role == IdentityRole.PERSON else f"--{role} "
        own = own.replace("@", " --site ")  # services of another site have an @ in their names
        if first := self.first_hubs:
            words = (
                f"This computer has no certificate for {wanted or 'you'}. On the computer of {first[0]}, `fleet hub "
                f"invite {option}{own}` prints a code; here, `fleet join HOST CODE --at 127.0.0.1` takes it"
            )
        elif (self.directory / f"{HUB}.key").is_file():
            words = self._why_not_at_first_hub(wanted, f"{option}{own}")
        else:
            words = (
                f"This computer has no certificate for {wanted or 'you'} at {self.endpoint}. On the hub's computer, "
                f"`fleet hub invite {option}{own}` prints a code; here, `fleet join HOST CODE` takes it"
            )
        raise NoCredentials(f"{words}.")

    def _why_not_at_first_hub(self, wanted: str, options: str) -> str:
        """Return why the first hub's own computer has no certificate of an identity, and what to do."""
        if not wanted or wanted.startswith(f"{IdentityRole.PERSON}."):
            return f"{self.directory / ME_FILE} does not say who uses this computer: `fleet hub init` writes it anew"
        if "@" in wanted:
            return f"This computer is the first hub, so it has no certificate for {wanted}: leave --site out"
        local = "" if any("127.0.0.1" not in each for each in self.listens) else "--local "
        return f"The hub's computer has no certificate for {wanted}: `fleet hub init {local}{options}` makes it"

    def dates(self, identity: str) -> CertificateDates | None:
        """Return when the certificate of an identity begins and ends, or None if there is none."""
        try:
            return CertificateDates.of((self.directory / f"{identity}.pem").read_bytes())
        except OSError:
            return None

    def why_invalid(self, identity: str) -> str:
        """Return why a hub refuses this identity's certificate: it has ended, or not yet begun. Empty if neither."""
        dates, now = self.dates(identity), datetime.now(UTC)
        if dates is None or dates.begins <= now < dates.ends:
            return ""
        begins, ends = dates.begins, dates.ends
        if now < begins:
            return f"The certificate of {identity} begins on {begins:%Y-%m-%d}: is the clock of this computer right?"
        return (
            f"The certificate of {identity} ended on {ends:%Y-%m-%d}, so the hub refuses it: it cannot even stop a "
            "car. `fleet hub invite` on the hub's computer and `fleet join` here make a new one; on the hub's own "
            "computer, `fleet up` does."
        )

    def of_client(self, wanted: str = "") -> dict[str, Any]:
        """Return Zenoh's settings of the link of a client. Raises NoCredentials."""
        name = self.identity(wanted)
        return self._link({"connect_certificate": self._path(name), "connect_private_key": self._path(name, ".key")})

    def of_hub(self) -> dict[str, Any]:
        """Return Zenoh's settings of the links of the hub. Raises NoCredentials."""
        if not (self.directory / f"{HUB}.key").is_file():
            raise NoCredentials(
                f"This computer has no certificate to be the hub at {self.endpoint}. `fleet up --secure` or "
                "`fleet hub init` makes one."
            )
        own, key = self._path(HUB), self._path(HUB, ".key")
        settings = {"listen_certificate": own, "listen_private_key": key}
        if self.first_hubs:
            settings |= {"connect_certificate": own, "connect_private_key": key}
        return self._link(settings)

    @property
    def listens(self) -> list[str]:
        """Return the endpoints that the hub listens on. Raises NoCredentials."""
        return list(self.hub_settings()[LISTEN])

    @property
    def access_control(self) -> dict[str, Any]:
        """Return the rules of the hub, in Zenoh's form. Raises NoCredentials."""
        return dict(self.hub_settings()[ACCESS_CONTROL])

    @property
    def first_hubs(self) -> list[str]:
        """Return the endpoints of the first hub, to which this site's hub links. Empty if this is no hub of a site."""
        try:
            return list(self.hub_settings()[CONNECT])
        except NoCredentials:
            return []

    @property
    def site(self) -> str:
        """Return the name of the site whose hub this computer is. Empty if it is no hub of a site."""
        try:
            return str(self.hub_settings()[SITE])
        except NoCredentials:
            return ""

    def store_site(self, site: str, listens: list[str], first_hubs: list[str], rules: Mapping[str, Any]) -> None:
        """Write the hub's file at another site: its name, where the hub listens, where it links to, and its rules.

        Raises OSError.
        """
        made = {SITE: site, LISTEN: listens, CONNECT: first_hubs, ACCESS_CONTROL: dict(rules)}
        write_atomically(self.directory / HUB_FILE, json.dumps(made, indent=1).encode(), sync=True, private=True)

    def hub_settings(self) -> dict[str, Any]:
        """Return the content of the hub's file. Raises NoCredentials."""
        path = self.directory / HUB_FILE
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            return {
                LISTEN: list(found[LISTEN]),
                ACCESS_CONTROL: dict(found[ACCESS_CONTROL]),
                CONNECT: list(found.get(CONNECT, ())),
                OF_SITES: dict(found.get(OF_SITES, {})),
                SITE: str(found.get(SITE, "")),
            }
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise NoCredentials(
                f"{path} has no rules of a hub: {error!r}. On the first hub's computer, `fleet hub init` writes them. "
                "At another site, `fleet join` with a new code does."
            ) from None

    def _path(self, name: str, ending: str = ".pem") -> str:
        return str(self.directory / f"{name}{ending}")

    def _link(self, own: dict[str, str]) -> dict[str, Any]:
        tls = {
            "root_ca_certificate": self._path("ca"),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        }
        return {"protocols": [self.endpoint.partition("/")[0]], "tls": {**tls, **own}}
