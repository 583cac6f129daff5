"""The texts of outcomes: what a command did, by verb and result. Pure."""

from typing import Final

from fleet.client.claims import NOT_CONFIRMED, STOP_SENT, STOPPED
from schemas.commands import COMMANDS, STOPPING_VERBS, Verb
from schemas.words import Basis, Phase, Reason

_ANY: Final = "*"
UNCONFIRMED: Final = "unconfirmed"
"""The result of a stop or a drive whose basis is `sent`: the frames were sent, and no reading shows their effect."""
RELEASE: Final = "release"
ESTOP_FLEET: Final = "estop_fleet"
"""Verbs that exist only in this module: for a drive with motion stop, and for an e-stop of all cars."""
_ESTOP: Final[dict[str, str]] = {
    Basis.SHOWN: "emergency-stopped ({took_s:.1f} s)",
    Phase.COMPLETE: "emergency-stopped ({took_s:.1f} s)",
    UNCONFIRMED: "emergency stop sent, {words}",
    Phase.SENT: "emergency stop sent",
}
_STOP: Final[dict[str, str]] = {
    Basis.SHOWN: f"{STOPPED} ({{took_s:.1f}} s)",
    Phase.COMPLETE: f"{STOPPED} ({{took_s:.1f}} s)",
    UNCONFIRMED: f"{STOP_SENT}, {{words}}",
    Phase.SENT: STOP_SENT,
}

EFFECTS: Final[dict[str, dict[str, str]]] = {
    **{verb: {Phase.SENT: row.effect} for verb, row in COMMANDS.items() if row.effect},
    Verb.DRIVE: {
        Phase.COMPLETE: "drive over{detail}",
        UNCONFIRMED: "{words}",
        Phase.SENT: "drive sent,{detail}",
    },
    RELEASE: {Basis.SHOWN: STOPPED, UNCONFIRMED: f"{STOP_SENT}, {{words}}", Phase.SENT: "nothing to stop"},
    Verb.STOP: _STOP,
    Verb.ESTOP: _ESTOP,
    ESTOP_FLEET: _ESTOP,
    Verb.RESUME: {Phase.SENT: "{words}", Reason.ESTOPPED: "{words}", Reason.HELD: "{words}"},
    Verb.PAUSE: _STOP,
    _ANY: {
        Phase.COMPLETE: "done",
        Phase.SENT: "sent",
        Phase.REJECTED: "refused: {words}",
        Phase.SUPERSEDED: "ended early: {words}",
        Phase.EXPIRED: "not done: {words}",
        Phase.FAILED: "failed: {words}",
    },
}
"""Effect of a command, by verb and result."""
NEXT_STEPS: Final = {
    Verb.ESTOP: "Release it with `fleet resume {car} --estops`",
    ESTOP_FLEET: "One release frees all cars: `fleet resume --estops`",
    Verb.PAUSE: "Paused until `fleet unpause`",
}
"""End of the text of a command that was carried out, by verb."""

_STOP_FAILURES: Final = {
    Reason.NOT_SHOWN: f"{STOP_SENT}, {{words}}",
    Phase.REJECTED: "{words}",
    Phase.FAILED: "{words}",
}
"""Text of a stop that failed, by result. The gateway's words begin with the consequence for the car."""
STOP_VERBS: Final = STOPPING_VERBS | {RELEASE, ESTOP_FLEET}
_MAY_NEED_NO_FRAME: Final = frozenset((Verb.MODE, Verb.FAN))
"""Verbs for which nothing may have to be sent, as for the mode that the car is in. Only then do gateways add words."""


def describe(verb: str, results: tuple[str, ...], *, car: str, detail: str, words: str, took_s: float) -> str:
    """Describe what a command did. `results` are ordered, the most specific first, such as reason and phase."""
    if words and verb in _MAY_NEED_NO_FRAME and results[0] == Phase.SENT:
        return words
    tables = [EFFECTS.get(verb, {}), *([_STOP_FAILURES] if verb in STOP_VERBS else ()), EFFECTS[_ANY]]
    template = next((table[result] for result in results for table in tables if result in table), "{words}")
    shown = f" {detail}" if detail else ""
    if Reason.NOT_SHOWN in results and not words.startswith("NOT "):
        words = f"{NOT_CONFIRMED}: {car} {words}"
    text = template.format(car=car, detail=shown, words=words, took_s=took_s).removesuffix(": ").removesuffix(", ")
    return f"{text} ({words})" if words and "{words}" not in template else text


def with_code(text: str, code: str) -> str:
    """Append a reason code in brackets, so that a person can search for it."""
    return f"{text} [{code}]" if code else text
