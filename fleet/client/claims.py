"""Claims about a car's motors, mode and link, and their texts. Pure: time is an argument.

A car acknowledges nothing, so each such statement is a claim. It has a basis (the car's own readings, or only the
frames that were sent), a time since which it has been true, and an age: the time since its gateway published it. The
last claims of a gateway that has ended are shown as past ones, with their age, and never as present ones.

Lists, status, shutdown, doctor, console and Python all use these texts, so that a car is described in the same words
everywhere.
"""

from collections.abc import Mapping, Sequence
from math import isinf
from typing import Any, Final

from msgspec import Struct

from schemas import topics
from schemas.keys import name_of
from schemas.words import UNKNOWN, Basis, Motors

STOPPED: Final = "stopped"
"""How the text about a stop begins if the car's own readings show the stop."""
STOP_SENT: Final = "stop sent"
"""How the text about a stop begins if the frames of the stop were sent, and nothing shows the stop."""
NOT_CONFIRMED: Final = "NOT CONFIRMED"
"""How the text about a stop begins if readings should have shown the stop, but did not. If the
frames of the stop were sent, `STOP_SENT` may come before it."""
NOT_STOPPED: Final = "NOT STOPPED"
"""How the text about a stop begins if the stop did not reach the car, which may be moving."""
NO_GATEWAY: Final = "no gateway"


class CarClaim(Struct, frozen=True):
    """One statement about a car."""

    what: str
    """The claim, such as `off`, `tracking` or `online`. `unknown` if nobody knows."""
    basis: str = ""
    """Motors: `shown` (by the car's readings) or `sent` (only the frames speak for it). Mode: the gateway's verdict,
    `confirmed`, `assumed` or `contradicted`. Empty if there is none."""
    since_s: float | None = None
    """How long it has been so. None if that is not known."""
    age_s: float | None = None
    """Time since the gateway published it. None if it never did, or if the age is not known."""
    why: str = ""
    """The evidence or the cause, for a person."""
    past: "CarClaim | None" = None
    """The last claim of a gateway that is gone."""
    is_stale: bool = False
    """True if the gateway should have published it again meanwhile."""

    @property
    def with_basis(self) -> str:
        """The claim with its basis."""
        return f"{self.what} ({self.basis})" if self.basis else self.what

    @property
    def short(self) -> str:
        """The claim with its basis and, if it is old, its age: one cell of a table."""
        old = f"{describe_age(self.age_s)} old" if self.is_stale and self.age_s is not None else ""
        details = ", ".join(filter(None, (self.basis, old)))
        return f"{self.what} ({details})" if details else self.what

    @property
    def words(self) -> str:
        """The claim as a sentence without a period: what, basis, for how long, why."""
        if self.past is not None and self.past.age_s is not None:
            return f"{self.what}: its gateway is gone, and said {self.past.short} {describe_age(self.past.age_s)} ago"
        since = f" for {describe_age(self.since_s)}" if self.since_s is not None else ""
        return f"{self.short}{since}{f': {self.why}' if self.why else ''}"

    def as_dict(self) -> dict[str, Any]:
        """Return the claim as JSON values."""
        return {
            "what": self.what,
            "basis": self.basis or None,
            "since_s": _rounded(self.since_s),
            "age_s": _rounded(self.age_s if self.past is None else self.past.age_s),
            "words": self.words,
        }


def motors_claim(safety: Any, age_s: float = 0.0, *, present: bool = True) -> CarClaim:
    """Return the claim about the motors. `safety` is the newest fleet.v1.Safety, or None if there is none."""
    if safety is None or not safety.motors:
        return CarClaim(UNKNOWN)
    since_s = safety.trust_since_s if safety.HasField("trust_since_s") else None
    claim = _claim("state/safety", age_s, safety.motors, safety.motors_basis, since_s, safety.trust_evidence)
    return claim if present else CarClaim(UNKNOWN, past=claim)


def mode_claim(mode: Any, age_s: float = 0.0, *, present: bool = True) -> CarClaim:
    """Return the claim about the mode. `mode` is the newest fleet.v1.Mode, or None if there is none."""
    if mode is None or not mode.asked:
        return CarClaim(UNKNOWN)
    since_s = mode.since_s if mode.HasField("since_s") else None
    claim = _claim("state/mode", age_s, mode.asked, mode.verdict, since_s, mode.evidence)
    return claim if present else CarClaim(UNKNOWN, past=claim)


def link_claim(link: Any, age_s: float = 0.0, *, present: bool = True) -> CarClaim:
    """Return the claim about the link. `link` is the newest fleet.v1.Link, or None if there is none."""
    if link is None or not link.state:
        return CarClaim(UNKNOWN if present else NO_GATEWAY)
    claim = _claim("state/link", age_s, link.state, "", link.since_s, link.reason)
    return claim if present else CarClaim(NO_GATEWAY, past=claim)


def describe_stop(motors: CarClaim, car: str) -> str:
    """Describe what a gateway's last claim says about the car's stop: stopped, stop sent, or not confirmed."""
    if motors.what != Motors.OFF:
        return f"{NOT_CONFIRMED}: {car} has not shown that it stopped"
    if motors.basis == Basis.SHOWN:
        return STOPPED
    return ", ".join(filter(None, (STOP_SENT, motors.why)))


def may_still_move(words: str) -> bool:
    """Return True if these words about a car's last stop say that the car may be moving."""
    return words.startswith((NOT_STOPPED, NOT_CONFIRMED))


def describe_age(age_s: float) -> str:
    """Return a duration as a person reads it: 3 s, 12 min, 5 h."""
    if age_s < 120:
        return f"{age_s:.0f} s"
    return f"{age_s / 60:.0f} min" if age_s < 7200 else f"{age_s / 3600:.0f} h"


def describe_bars(estops: Sequence[str], hold: str, paused_by: str, lent_to: str) -> str:
    """Return what keeps a car from driving, for a cell of a table. Empty if nothing does.

    `estops` are ids. `hold` is a text about the hold, `paused_by` the sender of the pause, `lent_to` a person; each is
    empty if there is none. A hold is left out beside an e-stop, which is stronger.
    """
    stopped = f"e-stop {' '.join(estops)}" if estops else hold
    paused, lent = paused_by and f"paused by {name_of(paused_by)}", lent_to and f"lent to {lent_to}"
    return ", ".join(filter(None, (stopped, paused, lent)))


def _claim(topic: str, age_s: float, what: str, basis: str, since_s: float | None, why: str) -> CarClaim:
    """Return a claim from a message of this age.

    `since_s` is how long the claim had been true when the message was sent.
    """
    after_s = topics.TOPICS[topic].stale_after_s
    is_stale = after_s is not None and age_s > after_s
    if isinf(age_s):  # the stamp of the message cannot be used
        return CarClaim(what, basis, why=why, is_stale=is_stale)
    return CarClaim(what, basis, None if since_s is None else since_s + age_s, age_s, why, is_stale=is_stale)


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


class CarClaims(Struct, frozen=True):
    """The claims about one car."""

    motors: CarClaim
    mode: CarClaim
    link: CarClaim

    @property
    def by_name(self) -> dict[str, CarClaim]:
        """The claims by subject: motors, mode, link."""
        return {"motors": self.motors, "mode": self.mode, "link": self.link}


def claims_of(
    states: Mapping[str, Any], ages_s: Mapping[str, float] | None = None, *, present: bool = True
) -> CarClaims:
    """Return the claims about a car. `states` are the newest messages by topic, `ages_s` their ages."""
    ages = ages_s or {}

    def message_and_age(topic: str) -> tuple[Any, float]:
        return states.get(topic), ages.get(topic, 0.0)

    return CarClaims(
        motors_claim(*message_and_age("state/safety"), present=present),
        mode_claim(*message_and_age("state/mode"), present=present),
        link_claim(*message_and_age("state/link"), present=present),
    )


def describe_end_of_doubt(car: str) -> str:
    """Return a text that says how to end the doubt about a car that did not show its stop.

    No plan uses the car until then.
    """
    return (
        f"`fleet stop {car}` ends the doubt if the car then shows its stop. If a person has looked at the car, "
        f"`fleet resume {car}` ends it."
    )
