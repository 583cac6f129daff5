"""The rules of a hub: which identity may use which keys, in the form of Zenoh's access control. Pure.

A hub denies everything that no rule allows. Everyone with a certificate may read everything and stop every car. Beyond
that, an identity sends only in its own name:

- The gateway of a car publishes and answers under the keys of its car.
- A service publishes and answers under its own keys, such as `@recorder/**`. The simulator also publishes the true
  state of its cars.
- A locator publishes where the cars are (`sensor/pose`), and nothing else.
- Every identity asks for its next certificate under a key with its own name.
- A command has the identity of its sender in its key: `fleet/red/@cmd/@by/person.mia/drive`. Only `person.mia` may send
  under this key. The gateway decides what Mia may do, by `people:` in the fleet file, as on a hub without rules. So the
  rules stay the same when `people:` changes.

A rule of Zenoh matches a message if one of the rule's key expressions includes the message's key expression. So a
program that answers queries with wildcards needs these wildcards in its rules. And `**` does not include parts that
begin with @ (docs/explanation/measurements.md#access-control).
"""

from collections.abc import Iterable, Sequence
from typing import Any, Final

from schemas import keys
from schemas.bus.credentials import HUB
from schemas.identity import IdentityRole, Service, parse, role_of

_READS: Final = ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query")
"""Kinds of messages with which a program asks for something."""
_TELLS: Final = ("put", "delete", "reply", "liveliness_token", "declare_queryable")
"""Kinds of messages with which a program publishes or answers, or offers to do so."""

_SERVICES: Final = (keys.COORDINATOR, keys.RECORDER, keys.SUPERVISOR, keys.SIMULATOR, keys.OPERATOR, keys.REPLAY)
_PUBLIC: Final = (
    "**",
    "**/@adv/**",
    *(each for name in _SERVICES for each in (f"*/{name}", f"*/{name}/**", f"*/{name}/**/@adv/**")),
)
"""The keys that everyone may read."""
_COMMANDS: Final = (
    "*/*/@cmd/**",
    "*/*/@cmd/@by/**",
    *(each for name in _SERVICES for each in (f"*/{name}/@cmd/**", f"*/{name}/@cmd/@by/**")),
)
"""The keys of all commands. Everyone may see who answers them, and that somebody drives. Sending needs another rule."""
_OF_HUBS: Final = (*_PUBLIC, *_COMMANDS, keys.HUB_RULES, keys.renewal_key("*"))
"""The keys that hubs of different sites may pass on to each other."""
_OWN_SERVICE: Final = {
    Service.SUPERVISOR: keys.SUPERVISOR,
    Service.COORDINATOR: keys.COORDINATOR,
    Service.RECORDER: keys.RECORDER,
    Service.SIMULATOR: keys.SIMULATOR,
}


def access_control(names: Iterable[tuple[str, str]], *, of_site: bool = False) -> dict[str, Any]:
    """Return the rules for identities, each with the common name of its certificate.

    of_site: make the rules for the hub of another site, which is linked to the first hub. A hub passes on only what it
    has checked by the same rules, so another hub may do everything.
    """
    rules = [
        _rule("passes on", "ingress", _READS + _TELLS, _OF_HUBS),
        _rule("gets", "egress", _READS + _TELLS, _OF_HUBS),
        _rule("read", "ingress", _READS, _PUBLIC),
        _rule("see drives", "ingress", ("declare_subscriber",), _COMMANDS),
        _rule("answers", "egress", _TELLS, (*_PUBLIC, *_COMMANDS, keys.renewal_key("*"))),
    ]
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for identity, common_name in (*names, *([(HUB, HUB)] if of_site else ())):
        if identity == HUB or role_of(identity) is IdentityRole.SITE:
            subjects.append({"id": identity, "cert_common_names": [common_name]})
            policies.append({"subjects": [identity], "rules": ["passes on", "gets"]})
            continue
        own = [*_speaks(identity), *_answers(identity)]
        rules += own
        subjects.append({"id": identity, "cert_common_names": [common_name]})
        policies.append(
            {"subjects": [identity], "rules": ["read", "see drives", "answers", *(each["id"] for each in own)]}
        )
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _speaks(identity: str) -> list[dict[str, Any]]:
    """Return the rules for commands, tokens and renewals that an identity sends."""
    known = parse(identity)
    if known is None:
        return []
    role, name = known
    tokens = f"*/{keys.OPERATOR}/*" if role is IdentityRole.SERVICE else f"*/{keys.OPERATOR}/{name}@$*"
    services = [f"*/{each}/@cmd/@by/{identity}/*" for each in _SERVICES]
    return [
        _rule(f"{identity} commands", "ingress", ("query", "put"), (f"*/*/@cmd/@by/{identity}/*", *services)),
        _rule(f"{identity} is there", "ingress", ("liveliness_token",), (tokens,)),
        _rule(f"{identity} renews", "ingress", ("query",), (keys.renewal_key(identity),)),
    ]


def _answers(identity: str) -> list[dict[str, Any]]:
    """Return the rules for publications and answers of an identity."""
    known = parse(identity)
    if known is None:
        return []
    role, name = known
    # Others ask with wildcards, so allow the wildcards, too. A query that no rule includes does not arrive.
    is_asked = _rule(f"{identity} is asked", "egress", _READS, (*_PUBLIC, *_COMMANDS))
    if known == (IdentityRole.SERVICE, Service.LOCATOR):
        return [_rule(f"{identity} tells", "ingress", _TELLS, ("*/*/sensor/pose", "*/*/sensor/pose/@adv/**")), is_asked]
    if role is IdentityRole.PERSON or (role is IdentityRole.SERVICE and name not in _OWN_SERVICE):
        return []
    chunk = name if role is IdentityRole.CAR else _OWN_SERVICE[Service(name)]
    own = [f"*/{chunk}", f"*/{chunk}/**", f"*/{chunk}/**/@adv/**"]
    if name == Service.SIMULATOR:
        own += ["*/*/sim/**", "*/*/sim/**/@adv/**"]
    commands = [f"*/{chunk}/@cmd/**", f"*/{chunk}/@cmd/@by/**"]
    return [
        _rule(f"{identity} tells", "ingress", _TELLS, own),
        _rule(f"{identity} answers", "ingress", ("reply", "declare_queryable"), commands),
        is_asked,
        _rule(f"{identity} is driven", "egress", ("put",), commands),
    ]


def _rule(name: str, flow: str, messages: Sequence[str], expressions: Sequence[str]) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(dict.fromkeys(expressions)),
    }
