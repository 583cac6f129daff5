"""Lets one other computer join the hub, once, within ten minutes: the server on the hub's side, and the client.

The client makes its own key, and the key never leaves the client. The code of an invitation has two halves: a secret,
and a pin that identifies the hub. The client sends a request for a certificate, with the secret half. The hub decides
which identity the certificate gets.
"""

import base64
import http.client
import json
import ssl
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final

from msgspec import Struct, field

from fleet.hub import certificate_authority
from fleet.hub.certificate_authority import BadRequestForCertificate
from fleet.hub.hub_store import HubStore
from fleet.hub.join_code import JOIN_CODE_LIFETIME_S, MAX_GUESSES, JoinCode
from schemas.bus import BusError
from schemas.bus.credentials import CA_FILE, HUB, OF_SITES
from schemas.identity import IdentityRole, role_of
from schemas.printable import printable

JOIN_PORT: Final = 7448
MAX_JOIN_REQUEST_BYTES: Final = 16_384
_MAX_DISCARDED_BYTES: Final = 4 * MAX_JOIN_REQUEST_BYTES
"""Maximum number of bytes that are read from a request that is too long. If more stay unread, the answer may be
lost."""
MAX_JOIN_ANSWER_BYTES: Final = 16 << 20
"""Maximum size of an answer. It has a fleet file and, for the hub of a site, the rules: 2.4 kB for each identity."""
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


class Invitation:
    """The server for one invitation. `wait` returns when somebody has joined, or when nobody may join any more."""

    def __init__(
        self,
        store: HubStore,
        identity: str,
        *,
        hub_port: int,
        address: str = "",
        port: int = JOIN_PORT,
        fleet_file: str = "",
    ) -> None:
        """Listen. Raises OSError if the port is in use."""
        ca = (store.directory / CA_FILE).read_bytes()
        self.code = JoinCode.new(certificate_authority.fingerprint(ca))
        self.joined_from = ""
        """Address of the computer that has joined. Empty until then."""
        self._answer = {"port": hub_port, "fleet_file": fleet_file, "identity": identity}
        self._store = store
        self._identity = identity
        self._ca = ca
        self._wrong = 0
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._server = ThreadingHTTPServer((address, port), self._handler())
        self._server.daemon_threads = True
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(store.directory / f"{HUB}.pem", store.directory / f"{HUB}.key")
        # The thread of each connection does the handshake. So a stranger who sends nothing cannot block others.
        self._server.socket = context.wrap_socket(self._server.socket, server_side=True, do_handshake_on_connect=False)
        self._thread = threading.Thread(target=self._server.serve_forever, name="invitation", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """Return the port on which the server listens."""
        return int(self._server.server_address[1])

    def wait(self, timeout_s: float = JOIN_CODE_LIFETIME_S) -> str:
        """Wait until somebody has joined. Return an empty text then, or the reason why nobody can join any more."""
        if not self._over.wait(timeout_s):
            return f"nobody has joined within {timeout_s / 60:g} minutes"
        return "" if self.joined_from else f"{MAX_GUESSES} wrong codes came: this code is no longer valid"

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def _take(self, guess: str, request: bytes, addresses: list[str], source: str) -> tuple[int, dict[str, Any]]:
        """Return the answer to a request to join: HTTP status and fields.

        `addresses` are those of the joining computer.
        """
        is_site = role_of(self._identity) is IdentityRole.SITE
        with self._lock:
            if self._over.is_set():
                return 410, {"error": "this code was used or has expired: `fleet hub invite` makes another one"}
            if not self.code.is_secret(guess):
                self._wrong += 1
                if self._wrong >= MAX_GUESSES:
                    self._over.set()
                return 403, {"error": "the code is wrong"}
            try:
                names = ("localhost", "127.0.0.1", *addresses) if is_site else ()
                certificate = self._store.sign(request, self._identity, datetime.now(UTC), names)
                rules = self._store.credentials.hub_settings()[OF_SITES] if is_site else {}
            except BadRequestForCertificate as error:
                return 400, {"error": str(error)}
            except OSError as error:
                return 500, {"error": f"the hub cannot store the certificate: {error.strerror or error}"}
            self.joined_from = source
            self._over.set()
            own = {"certificate": certificate.decode(), "ca": self._ca.decode(), "rules": rules}
            return 200, {**self._answer, **own}

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        invitation = self

        class Handler(BaseHTTPRequestHandler):
            timeout = SOCKET_TIMEOUT_S

            def do_GET(self) -> None:
                """Return the certificate of the authority, which is not a secret."""
                self._send(200, {"ca": invitation._ca.decode()})

            def do_POST(self) -> None:
                try:
                    length = int(self.headers.get("Content-Length", "0"))
                    if not 0 < length <= MAX_JOIN_REQUEST_BYTES:
                        # Unread bytes would reset the connection when it closes, and the answer could be lost.
                        self.rfile.read(min(max(length, 0), _MAX_DISCARDED_BYTES))
                        self._send(413, {"error": f"a request must have 1 to {MAX_JOIN_REQUEST_BYTES} bytes"})
                        return
                    asked = json.loads(self.rfile.read(length))
                    guess, request = str(asked["secret"]), base64.b64decode(asked["request"], validate=True)
                    addresses = [str(each) for each in list(asked.get("addresses", ()))[:MAX_HUB_NAMES]]
                except (ValueError, KeyError, TypeError):
                    self._send(400, {"error": "it is not a request to join"})
                    return
                self._send(*invitation._take(guess, request, addresses, str(self.client_address[0])))

            def log_message(self, *_: object) -> None:
                """Log nothing, because strangers could fill the terminal."""

            def _send(self, status: int, fields: dict[str, Any]) -> None:
                body = json.dumps(fields).encode()
                self.send_response(status)
                self.send_header("Content-Type", "application/json")
                self.send_header("Content-Length", str(len(body)))
                self.send_header("Connection", "close")
                self.end_headers()
                self.wfile.write(body)

        return Handler


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
    connection = http.client.HTTPSConnection(where, timeout=SOCKET_TIMEOUT_S, context=context)
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
