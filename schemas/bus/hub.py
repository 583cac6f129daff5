"""The hub: a Zenoh router in its own process. By default it listens on loopback, and exits 10 s after its last client.

The listening port is the mutex: a second hub on the same port fails at once. `bus.ensure_hub` starts a hub; you can
start one by hand: `python -m schemas.bus.hub --endpoint tcp/127.0.0.1:7447`.
"""

import argparse
import contextlib
import json
import os
import sys
import threading
import time
from typing import Final

import zenoh

from schemas import keys
from schemas.bus import DEFAULT_ENDPOINT, BusError, check_listening, is_secure, router_config
from schemas.bus.credentials import HUB, HUB_FILE, OF_SITES, Credentials
from schemas.bus.hub_links import HubLinks, links_of
from schemas.bus.hub_renewals import HubRenewals
from schemas.identity import IdentityRole
from schemas.process import signals
from schemas.process.panic_watch import PanicWatch

IDLE_S: Final = 10.0
"""Time without a client after which the hub exits. A linked hub of another site is not a client."""
_POLL_S: Final = 0.5
RULES_POLL_S: Final = 2.0
"""Interval at which the hub of another site asks for the rules."""
RULES_TIMEOUT_S: Final = 1.0


def serve(endpoint: str, idle_s: float, stop: threading.Event) -> None:
    """Route until `stop` is set or there was no client for `idle_s`.

    When the rules or the certificate of a hub change, it opens a new session, because Zenoh reads them only then.
    Clients reconnect soon. Raises zenoh.ZError if the port is in use, BusError.
    """
    last_link = time.monotonic()
    links = HubLinks(Credentials.of(endpoint)) if is_secure(endpoint) else None
    while not stop.is_set():
        rules = _rules_changed_at(endpoint)
        with zenoh.open(router_config(endpoint)) as session, contextlib.closing(HubRenewals(endpoint, session)):
            asked = -RULES_POLL_S
            if links is not None:
                _answer_sites(links, session)
            while not stop.wait(_POLL_S) and _rules_changed_at(endpoint) == rules:
                now = time.monotonic()
                if links is not None:
                    links.write(links_of(session), now)
                    if now - asked >= RULES_POLL_S:
                        asked = now
                        _take_rules(links, session)
                if _has_clients(session):
                    last_link = now
                elif now - last_link > idle_s:
                    return


def _has_clients(session: zenoh.Session) -> bool:
    """Return True if any client is linked. Hubs of other sites do not count: they would keep one another running."""
    hubs = (HUB, f"{IdentityRole.SITE}.")
    return any(not (link.auth_identifier or "").startswith(hubs) for link in session.info.links())


def _answer_sites(links: HubLinks, session: zenoh.Session) -> None:
    """Answer the hubs of other sites with their rules, and keep the links that they send, until the session ends."""
    if not (rules := links.credentials.hub_settings()[OF_SITES]):
        return
    payload = json.dumps(rules)

    def answer(query: zenoh.Query) -> None:
        with query:
            if query.payload is not None:
                links.take(query.payload.to_bytes(), time.monotonic())
            query.reply(keys.HUB_RULES, payload)

    session.declare_queryable(keys.HUB_RULES, answer)


def _take_rules(links: HubLinks, session: zenoh.Session) -> None:
    """Ask the first hub for the rules, if this hub is at another site, and store them. Without an answer, do nothing.

    The query also tells the first hub which programs are connected here.
    """
    credentials = links.credentials
    if not credentials.first_hubs:
        return
    for reply in session.get(keys.HUB_RULES, payload=links.of_this_site(), timeout=RULES_TIMEOUT_S):
        if reply.ok is None:
            continue
        with contextlib.suppress(ValueError):
            rules = json.loads(reply.ok.payload.to_bytes())
            if isinstance(rules, dict) and rules and rules != credentials.access_control:
                with contextlib.suppress(OSError):  # the next poll tries again
                    credentials.store_site(credentials.site, credentials.listens, credentials.first_hubs, rules)


def _rules_changed_at(endpoint: str) -> tuple[int, ...]:
    """Return when a hub's rules and certificate were written, ns since the epoch. Empty if it has none."""
    if not is_secure(endpoint):
        return ()
    directory = Credentials.of(endpoint).directory
    try:
        return tuple((directory / name).stat().st_mtime_ns for name in (HUB_FILE, f"{HUB}.pem"))
    except FileNotFoundError:
        return ()


def main() -> int:
    """Run a hub. Return 0 at its regular end, 1 if it could not listen, 2 for wrong use."""
    parser = argparse.ArgumentParser(prog="python -m schemas.bus.hub", description=__doc__)
    parser.add_argument("--endpoint", default=DEFAULT_ENDPOINT)
    parser.add_argument(
        "--idle-s", type=float, default=IDLE_S, help="end after this time without a client (default 10)"
    )
    parser.add_argument(
        "--insecure-lan", action="store_true", help="listen on a network, where everyone can drive the cars"
    )
    arguments = parser.parse_args()
    try:
        check_listening(arguments.endpoint, insecure_lan=arguments.insecure_lan)
    except BusError as error:
        sys.stderr.write(f"hub: {error}\n")
        return 2
    stop = threading.Event()
    signals.calls(stop.set)
    with PanicWatch() as watch:
        threading.Thread(target=_begin_again, args=(watch,), daemon=True).start()
        try:
            serve(arguments.endpoint, arguments.idle_s, stop)
        except (zenoh.ZError, BusError) as error:
            sys.stderr.write(f"hub: cannot listen on {arguments.endpoint}: {error}\n")
            return 1
    return 0


def _begin_again(watch: PanicWatch) -> None:
    """Replace this process with a new hub after a panic in Zenoh, because the router then ignores some links.

    A panic was seen when the hub of one site was restarted several times within seconds (Zenoh 1.10.2). Clients
    reconnect within a second, as after a change of the rules.
    """
    watch.panicked.wait()
    watch.restore()
    sys.stderr.write("hub: Zenoh's router has failed, so the hub restarts\n")
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])  # noqa: S606 - this same program


if __name__ == "__main__":
    sys.exit(main())
