"""The files of a hub on its own computer: its authority, its identities, its rules. See schemas/bus/credentials.py.

`identities.json` lists who has a certificate. If an identity is revoked and joins again, it gets another common name,
so that its earlier certificate stays invalid.
"""

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Self

from msgspec import Struct, field, to_builtins

from fleet.hub import certificate_authority
from fleet.hub.access_rules import access_control
from fleet.hub.certificate_authority import BadRequestForCertificate, KeyPair
from fleet.hub.certificate_parts import LIFETIME
from schemas.atomic_file import write_atomically
from schemas.bus import BusError
from schemas.bus.credentials import (
    ACCESS_CONTROL,
    CA_FILE,
    HUB,
    HUB_FILE,
    LISTEN,
    ME_FILE,
    OF_SITES,
    Credentials,
    NoCredentials,
)
from schemas.identity import parse
from schemas.process.file_lock import FileLock

CA_KEY_FILE: Final = "ca.key"
IDENTITIES_FILE: Final = "identities.json"
LOCK_FILE: Final = "lock"


class BrokenHub(BusError):
    """The files of the hub are damaged. The text says which, and what to do."""


class KnownIdentity(Struct):
    """One identity that has a certificate."""

    until: str
    """When its certificate expires, ISO 8601, UTC."""
    generation: int = 1
    """Number of common names that the identity has had. The number is part of the common name unless it is 1."""
    revoked: bool = False
    local: bool = False
    """True if its key is on this computer."""

    @classmethod
    def of(cls, stored: Mapping[str, Any]) -> Self:
        """Return a stored identity.

        Raises ValueError if `until` or `generation` has a wrong type, and TypeError for an unknown field.
        """
        if type(stored.get("until")) is not str or type(stored.get("generation", 1)) is not int:
            raise ValueError(f"it has {stored}")
        return cls(**stored)

    def common_name(self, identity: str) -> str:
        """Return the common name of its certificate."""
        return identity if self.generation == 1 else f"{identity}.{self.generation}"


class HubStore(Struct):
    """The files of one hub."""

    credentials: Credentials
    known: dict[str, KnownIdentity] = field(default_factory=dict)

    @classmethod
    def of(cls, endpoint: str) -> Self:
        """Return the files of the hub at an endpoint. Raises BrokenHub."""
        return cls.load(Credentials.of(endpoint))

    @classmethod
    def load(cls, credentials: Credentials) -> Self:
        """Return the files of a hub. Raises BrokenHub."""
        store = cls(credentials)
        store._read_known()
        return store

    def _read_known(self) -> None:
        path = self.directory / IDENTITIES_FILE
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            self.known = {name: KnownIdentity.of(each) for name, each in found.items()}
        except FileNotFoundError:
            pass
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise BrokenHub(
                f"{path} is damaged: {error}. Restore it from a copy, or start again: move {self.directory} away, "
                "`fleet hub init`, and let everyone join again."
            ) from None

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Lock the files against changes by other programs, and read them again. Raises OSError, BrokenHub."""
        path = self.directory / LOCK_FILE
        with ExitStack() as stack:
            try:
                stack.enter_context(FileLock(path).held())
            except TimeoutError:
                raise BrokenHub(f"another program is changing the hub's files and holds {path}: try again") from None
            self._read_known()
            yield

    @property
    def directory(self) -> Path:
        """Return the directory of the files."""
        return self.credentials.directory

    @property
    def is_hub(self) -> bool:
        """Return True if this computer has the authority of the hub."""
        return (self.directory / CA_KEY_FILE).is_file()

    def ensure(
        self,
        identities: Iterable[str],
        me: str,
        *,
        addresses: Iterable[str],
        listens: Iterable[str] = (),
        take: Iterable[str] = (),
        now: datetime | None = None,
    ) -> None:
        """Make the authority if it is missing, and missing or due certificates of the hub and the identities here.

        Then write the rules.

        `addresses` are IP addresses and names under which others reach the hub. `listens` are the hub's endpoints, if
        they change. `take` are further identities for this computer. A certificate that another computer has for one of
        them becomes invalid. Raises OSError, BrokenHub.
        """
        now = datetime.now(UTC) if now is None else now
        self.directory.mkdir(parents=True, exist_ok=True)
        os.chmod(self.directory, 0o700)  # noqa: PTH101 - a private directory
        if not self.is_hub and self.credentials.exist:
            raise BrokenHub(
                f"{self.directory} has the certificate of the hub's authority, and not its key: this computer has "
                "joined another one's hub (`fleet leave` ends that), or the key is lost. Then restore it from a "
                "copy, or move the directory away, and let everyone join again."
            )
        with self._changing():
            if not self.is_hub:
                self._write_pair("ca", certificate_authority.make_authority(now))
            names = tuple(dict.fromkeys(("localhost", "127.0.0.1", *addresses)))
            if self._is_due(HUB, now, names):
                self._write_pair(HUB, certificate_authority.issue(self._authority(), HUB, now, names))
            taken = {me, *take}
            for identity in dict.fromkeys((*identities, *take, me)):
                self._ensure_local(identity, now, take=identity in taken)
            write_atomically(self.directory / ME_FILE, me.encode(), private=True)
            self._save(listens)

    def reserve(self, identity: str, now: datetime | None = None) -> None:
        """Write the rules for an identity of another computer that has no certificate yet. Raises OSError, BrokenHub.

        An earlier certificate of this identity becomes invalid now, even if it is on this computer. Also raises
        BrokenHub for the identity of this computer's user, because nobody could undo that.
        """
        if identity == self.credentials.me:
            raise BrokenHub(f"{identity} uses the hub's own computer: invite somebody under another name")
        with self._changing():
            self.known[identity] = self._next(identity, datetime.now(UTC) if now is None else now)
            self._forget_local(identity)
            self._save()

    def sign(self, request: bytes, identity: str, now: datetime, addresses: Iterable[str] = ()) -> bytes:
        """Return the certificate of a reserved identity, PEM.

        addresses: the addresses of the joining computer, if it becomes a hub.

        Raises OSError, BrokenHub, and BadRequestForCertificate, also if the identity was revoked or invited again
        meanwhile.
        """
        reserved = self.known[identity]
        with self._changing():
            entry = self.known.get(identity)
            if entry is None or entry.revoked or entry.generation != reserved.generation:
                raise BadRequestForCertificate(f"{identity} was revoked, or invited again, meanwhile")
            certificate = certificate_authority.sign_request(
                self._authority(), request, entry.common_name(identity), now, addresses
            )
            entry.until = _until(now)
            self._save()
        return certificate

    def renew(self, certificate: bytes, request: bytes, identity: str, now: datetime) -> bytes:
        """Return the next certificate of an identity, PEM, for the same key. See `certificate_authority.renew`.

        Raises OSError, BrokenHub, and BadRequestForCertificate, also if the identity is revoked.
        """
        with self._changing():
            entry = self.known.get(identity)
            if entry is None or entry.revoked:
                raise BadRequestForCertificate(f"{identity} is revoked, or was never invited")
            made = certificate_authority.renew(
                self._authority(), certificate, request, entry.common_name(identity), now
            )
            entry.until = _until(now)
            self._save()
        return made

    def renew_hub(self, now: datetime) -> bool:
        """Make the next certificate of the hub itself if it is due. Return False if it is not.

        Raises OSError, BrokenHub.
        """
        certificate = self._read(HUB)
        if not certificate_authority.is_due(certificate, now):
            return False
        with self._changing():
            self._write_pair(
                HUB,
                certificate_authority.issue(self._authority(), HUB, now, certificate_authority.names_of(certificate)),
            )
        return True

    def revoke(self, identity: str) -> bool:
        """Deny everything to an identity. It may be revoked already. Return False if it is not known.

        Raises OSError, BrokenHub.
        """
        with self._changing():
            entry = self.known.get(identity)
            if entry is None:
                return False
            entry.revoked = True  # also if it is revoked already: the last attempt may have failed half way
            self._forget_local(identity)
            self._save()
        return True

    def _forget_local(self, identity: str) -> None:
        for ending in (".pem", ".key"):
            (self.directory / f"{identity}{ending}").unlink(missing_ok=True)

    def _ensure_local(self, identity: str, now: datetime, *, take: bool) -> None:
        assert parse(identity) is not None, identity
        entry = self.known.get(identity)
        if entry is not None and not entry.local and not entry.revoked and not take:
            return  # another computer has the certificate
        if entry is None or entry.revoked or not entry.local:
            entry = self._next(identity, now)
        elif not self._is_due(identity, now):
            return
        entry.local, entry.until = True, _until(now)
        self._write_pair(identity, certificate_authority.issue(self._authority(), entry.common_name(identity), now))
        self.known[identity] = entry

    def _next(self, identity: str, now: datetime) -> KnownIdentity:
        """Return the entry for a new certificate, which makes an earlier certificate of this identity invalid."""
        before = self.known.get(identity)
        return KnownIdentity(_until(now), 1 if before is None else before.generation + 1)

    def _is_due(self, name: str, now: datetime, addresses: Iterable[str] = ()) -> bool:
        """Return True if a certificate on this computer must be made because it is missing, damaged or due."""
        certificate = self._read(name)
        is_whole = certificate_authority.belong(certificate, self._read(name, "key"))
        return not is_whole or certificate_authority.is_due(certificate, now, addresses)

    def _save(self, listens: Iterable[str] = ()) -> None:
        """Write the identities, and the rules if they changed. The hub opens a new session when the rules change."""
        stored: Mapping[str, object] = {name: to_builtins(each) for name, each in sorted(self.known.items())}
        path = self.directory / HUB_FILE
        chosen = list(listens)
        if not chosen:
            with suppress(NoCredentials):  # the file is missing or damaged: use loopback
                chosen = self.credentials.listens
        allowed = [(name, each.common_name(name)) for name, each in self.known.items() if not each.revoked]
        settings = {
            LISTEN: chosen,
            ACCESS_CONTROL: access_control(sorted(allowed)),
            OF_SITES: access_control(sorted(allowed), of_site=True),
        }
        made = json.dumps(settings, indent=1).encode()
        # Write the rules first, then the list. Otherwise, if the disk is full in between, the list could call somebody
        # revoked who can still connect.
        if not path.exists() or path.read_bytes() != made:
            write_atomically(path, made, private=True)
        write_atomically(self.directory / IDENTITIES_FILE, json.dumps(stored, indent=1).encode(), private=True)

    def _authority(self) -> KeyPair:
        found = KeyPair((self.directory / CA_FILE).read_bytes(), (self.directory / CA_KEY_FILE).read_bytes())
        if not certificate_authority.belong(found.certificate, found.key):
            raise BrokenHub(
                f"{self.directory / CA_KEY_FILE} is not the key of {CA_FILE}: restore both from a copy, or move the "
                "directory away, `fleet hub init`, and let everyone join again."
            )
        return found

    def _read(self, name: str, ending: str = "pem") -> bytes:
        try:
            return (self.directory / f"{name}.{ending}").read_bytes()
        except FileNotFoundError:
            return b""

    def _write_pair(self, name: str, pair: KeyPair) -> None:
        write_atomically(self.directory / f"{name}.key", pair.key, private=True)
        write_atomically(self.directory / f"{name}.pem", pair.certificate, private=True)


def _until(now: datetime) -> str:
    """Return when a certificate that is made now expires."""
    return (now + LIFETIME).isoformat(timespec="seconds")
