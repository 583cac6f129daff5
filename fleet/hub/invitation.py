"""The hub's side of `fleet join`: a server that lets one other computer join, once, within ten minutes.

The other computer makes its own key, which never leaves it. The code of an invitation has two halves: a secret, and a
pin that identifies the hub. The other computer sends a request for a certificate, with the secret half. The hub decides
which identity the certificate gets. `join` is the side of the other computer.
"""

import base64
import json
import ssl
import threading
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final

from fleet.hub import certificate_authority
from fleet.hub.certificate_authority import BadRequestForCertificate
from fleet.hub.hub_store import BrokenHub, HubStore
from fleet.hub.join import JOIN_PORT, MAX_HUB_NAMES, SOCKET_TIMEOUT_S
from fleet.hub.join_code import JOIN_CODE_LIFETIME_S, MAX_GUESSES, JoinCode
from schemas.bus.credentials import CA_FILE, HUB, OF_SITES
from schemas.identity import IdentityRole, role_of

MAX_JOIN_REQUEST_BYTES: Final = 16_384
_MAX_DISCARDED_BYTES: Final = 4 * MAX_JOIN_REQUEST_BYTES
"""Maximum number of bytes that are read from a request that is too long. If more stay unread, the answer may be
lost."""


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
            except BrokenHub as error:
                return 500, {"error": f"the hub cannot sign the certificate: {error}"}
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
