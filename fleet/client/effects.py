"""The texts of outcomes: what a command did, by verb and result. Pure."""

from typing import Final

from fleet.client.claims import NOT_CONFIRMED, STOP_SENT, STOPPED
from schemas.commands import COMMANDS

_ANY: Final = "*"
_ESTOP: Final[dict[str, str]] = {
    "shown": "emergency-stopped ({took_s:.1f} s)",
    "complete": "emergency-stopped ({took_s:.1f} s)",
    "unconfirmed": "emergency stop sent, {words}",
    "sent": "emergency stop sent",
}
_STOP: Final[dict[str, str]] = {
    "shown": f"{STOPPED} ({{took_s:.1f}} s)",
    "complete": f"{STOPPED} ({{took_s:.1f}} s)",
    "unconfirmed": f"{STOP_SENT}, {{words}}",
    "sent": STOP_SENT,
}

EFFECTS: Final[dict[str, dict[str, str]]] = {
    **{verb: {"sent": row.effect} for verb, row in COMMANDS.items() if row.effect},
    "drive": {
        "shown": "drove{detail}",
        "complete": "drive over{detail}",
        "unconfirmed": "{words}",
        "sent": "drive sent,{detail}",
    },
    "release": {"shown": STOPPED, "unconfirmed": f"{STOP_SENT}, {{words}}", "sent": "nothing to stop"},
    "stop": _STOP,
    "estop": _ESTOP,
    "estop_fleet": _ESTOP,
    "resume": {"sent": "{words}", "estopped": "{words}", "held": "{words}"},
    "pause": _STOP,
    _ANY: {
        "complete": "done",
        "sent": "sent",
        "rejected": "refused: {words}",
        "superseded": "ended early: {words}",
        "expired": "not done: {words}",
        "failed": "failed: {words}",
    },
}
"""Effect of a command, by verb and result. `release` is a drive with motion stop, `estop_fleet` an e-stop of all."""
NEXT_STEPS: Final = {
    "estop": "Release it with `fleet resume {car} --estops`",
    "estop_fleet": "One release frees all cars: `fleet resume --estops`",
    "pause": "Paused until `fleet unpause`",
}
"""End of the text of a command that was carried out, by verb."""

_STOP_FAILURES: Final = {"not_shown": f"{STOP_SENT}, {{words}}", "rejected": "{words}", "failed": "{words}"}
"""The gateway's words of a stop that failed begin with the fact for the car."""
STOP_VERBS: Final = frozenset({"stop", "estop", "estop_fleet", "pause", "release"})


def describe(verb: str, results: tuple[str, ...], *, car: str, detail: str, words: str, took_s: float) -> str:
    """Return what a command did. results: the most specific one first, such as reason and phase."""
    tables = [EFFECTS.get(verb, {}), *([_STOP_FAILURES] if verb in STOP_VERBS else ()), EFFECTS[_ANY]]
    template = next((table[result] for result in results for table in tables if result in table), "{words}")
    shown = f" {detail}" if detail else ""
    if "not_shown" in results and not words.startswith("NOT "):
        words = f"{NOT_CONFIRMED}: {car} {words}"
    text = template.format(car=car, detail=shown, words=words, took_s=took_s).removesuffix(": ").removesuffix(", ")
    return f"{text} ({words})" if words and "{words}" not in template else text


def with_code(text: str, code: str) -> str:
    """Append a reason code in brackets, so that a person can search for it."""
    return f"{text} [{code}]" if code else text
