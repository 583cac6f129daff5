"""Joins the hub on another computer, which has invited this one (`invitation`): the client of `fleet join`."""

import base64
import http.client
import json
import ssl
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import Any, Final

from msgspec import Struct, field

from fleet.hub import certificate_authority
from fleet.hub.join_code import JoinCode
from schemas.bus import BusError
from schemas.identity import role_of
from schemas.printable import printable

JOIN_PORT: Final = 7448
MAX_JOIN_ANSWER_BYTES: Final = 16 << 20
"""Maximum size of an answer. It has a fleet file and, for the hub of a site, the rules: 1 to 3 kB for each identity."""
MAX_HUB_NAMES: Final = 32
SOCKET_TIMEOUT_S: Final = 10.0
"""Timeout of a connection. A stranger who sends nothing cannot block others for longer."""


class NotJoined(BusError):
    """The hub did not let this computer join. The text says why."""


class NotThisHub(NotJoined):
    """No hub answers there, or the hub there did not make the code."""


class Joined(Struct, frozen=True):
    """Everything that a joining computer gets."""

    identity: str
    port: int
    """Port of the hub."""
    ca: bytes
    certificate: bytes
    key: bytes
    fleet_file: str = ""
    rules: Mapping[str, Any] = field(default_factory=dict)
    """The rules, if the computer becomes the hub of another site. Otherwise empty."""


def join(
    host: str,
    code: JoinCode,
    port: int = JOIN_PORT,
    clock: Callable[[], float] = time.time,
    addresses: Iterable[str] = (),
    own_authority: Callable[[bytes], bool] = lambda _: False,
) -> Joined:
    """Join the hub on another computer. Raises NotJoined.

    `addresses` are this computer's, in case it becomes a hub. own_authority: returns True for a certificate of an
    authority whose key this computer has. Then no code is sent, because the hub is this computer.
    """
    where = f"{host}:{port}"
    anyone = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    anyone.check_hostname, anyone.verify_mode = False, ssl.CERT_NONE  # the code shows whether it is the right hub
    found = _ask(where, anyone, "GET", None)
    ca, fits = b"", False
    try:
        # Allow only one certificate: OpenSSL would trust all of them, but the code is compared with only one.
        ca = certificate_authority.only_certificate(str(found.get("ca")).encode())
        fits = code.fits(certificate_authority.fingerprint(ca))
    except ValueError:
        pass
    if not fits:
        raise NotThisHub(
            f"{where} is not the hub that made this code, or the code is mistyped. Nothing was sent. If the code is "
            "right, somebody in this network pretends to be the hub."
        )
    if own_authority(ca):
        raise NotJoined(
            "this computer is the hub that made this code, so it needs none: type the command on the other computer. "
            "The code was not sent, and is still good"
        )
    # This checks certificate and name. Python's default settings would also reject hubs without key identifiers.
    known = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    known.load_verify_locations(cadata=ca.decode())
    key, request = certificate_authority.new_request("joins")
    own = {"addresses": list(addresses)[:MAX_HUB_NAMES]}
    asked = {"secret": code.secret, "request": base64.b64encode(request).decode(), **own}
    found = _ask(where, known, "POST", json.dumps(asked).encode())
    try:
        certificate = str(found["certificate"]).encode()
        if role_of(str(found["identity"])) is None:  # the identity becomes the name of a file
            raise NotJoined(f"{where} gave no identity: {printable(str(found['identity']))}")
        if certificate_authority.expires(certificate).timestamp() <= clock():
            raise NotJoined(f"the clock of this computer is wrong: the new certificate of {where} has ended already")
        rules, text = dict(found.get("rules", {})), str(found["fleet_file"])
        return Joined(str(found["identity"]), int(found["port"]), ca, certificate, key, text, rules)
    except (KeyError, ValueError, TypeError):
        raise NotJoined(f"{where} gave no certificate") from None


def join_one_of(
    found: Iterable[str],
    code: JoinCode,
    addresses: Iterable[str] = (),
    own_authority: Callable[[bytes], bool] = lambda _: False,
) -> tuple[str, Joined]:
    """Join the hub that made a code. Return that hub's host, and what it gave. Raises NotJoined.

    found: host:port of each hub to try. The code is sent only to the hub that made it. The other arguments are as for
    `join`.
    """
    own, tried = list(addresses), 0
    for each in found:
        host, _, port = each.rpartition(":")
        with suppress(NotThisHub):
            return host, join(host, code, int(port), addresses=own, own_authority=own_authority)
        tried += 1
    others = f" {tried} other{'s' * (tried != 1)} did not make this code." if tried else ""
    raise NotJoined(
        f"no hub in this network waits for you.{others} `fleet hub invite NAME` must run on its computer now. If "
        "this network passes no multicast, write its address: fleet join HOST CODE"
    )


def _ask(where: str, context: ssl.SSLContext, method: str, body: bytes | None) -> dict[str, Any]:
    """Send a request and return the fields of the answer. Raises NotJoined."""
    try:
        connection = http.client.HTTPSConnection(where, timeout=SOCKET_TIMEOUT_S, context=context)
        connection.host.encode("idna")  # as for the connection
    except (http.client.InvalidURL, UnicodeError):
        raise NotJoined(f"{printable(where)} is not the address of a computer") from None
    try:
        connection.request(method, "/join", body)
        answer = connection.getresponse()
        found = json.loads(answer.read(MAX_JOIN_ANSWER_BYTES))
        if answer.status != 200:
            raise NotJoined(f"{where}: {found['error']}")
        return dict(found)
    except ssl.SSLCertVerificationError as error:
        raise NotJoined(
            f"the certificate of {where} does not fit: {error.verify_message}. Is the clock of this computer right, "
            "and is this the address that `fleet hub invite` shows?"
        ) from None
    except (OSError, http.client.HTTPException) as error:
        raise NotThisHub(f"{where} does not answer: {error}. `fleet hub invite NAME` must run there now.") from None
    except (ValueError, KeyError, TypeError):
        raise NotJoined(f"{where} is not a hub: its answer is not understood") from None
    finally:
        connection.close()
