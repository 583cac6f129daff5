"""Persists the safety state of one car (its hold, e-stops, pauses and loan) in a small JSON file.

A hold, a loan or an e-stop of one car belongs to the car at one link: the simulated car `red` is not the car `red` on
the table. So the file has them for each link. Pauses and e-stops of the whole fleet do not depend on the link.
"""

import json
from collections.abc import Iterator
from math import inf
from pathlib import Path
from typing import Any, Final

from msgspec import Struct, to_builtins
from msgspec.structs import replace

from gateway.control.safety_state import PersistedSafety
from schemas.atomic_file import DAMAGE, write_state
from schemas.process.stdio import printable
from schemas.rights import Estop, FleetPause, Hold, Loan
from schemas.words import Rank

MAX_OTHER_LINKS: Final = 16
"""Maximum number of other links whose holds, loans and e-stops the file keeps. Beyond it, the oldest is dropped."""


class _OfLink(Struct, frozen=True):
    """The hold, e-stops and loan of the car at one link."""

    link: str
    hold: Hold | None
    estops: tuple[Estop, ...]
    loan: Loan | None

    @property
    def is_empty(self) -> bool:
        return self.hold is None and self.loan is None and not self.estops


class SafetyStateFile:
    """The state file of one car at one link. `link` is the text of `schemas.links.car_link`."""

    def __init__(self, directory: Path, fleet: str, car: str, link: str) -> None:
        self.path = directory / f"{fleet}.{car}.json"
        self.damage = ""
        """A sentence for a person if `load` found an unreadable file, else empty."""
        self.other_link_words = ""
        """A sentence for a person if `load` found a hold, a loan or an e-stop of another link, else empty."""
        self._link = link
        self._others: tuple[_OfLink, ...] = ()

    def load(self, now_ns: int) -> PersistedSafety:
        """Return the persisted state. A corrupted file counts as a hold, so that the car does not drive off."""
        self.damage, self.other_link_words, self._others = "", "", ()
        try:
            text = self.path.read_text(encoding="utf-8")
        except FileNotFoundError:
            return PersistedSafety()
        except (OSError, UnicodeDecodeError) as error:
            return self._unreadable(f": {error}", now_ns)
        try:
            content = json.loads(text)
            state, others = _parse(content, now_ns), tuple(_parse_others(content, now_ns))
            # In older versions there was only one car of a name, so their files name no link.
            link = _text(content.get("link", self._link))
        except DAMAGE:
            return self._unreadable("", now_ns)
        if link != self._link:
            others, state = _exchanged(others, state, was=link, now=self._link)
        self._others = others
        if others:
            self.other_link_words = self._words(others[-1], len(others) - 1)
        return state

    def save(self, state: PersistedSafety) -> None:
        """Replace the file atomically. Raises OSError if that fails."""
        content = to_builtins(state) | {"link": self._link, "others": [to_builtins(each) for each in self._others]}
        write_state(self.path, json.dumps(content), sync=True)

    def _unreadable(self, why: str, now_ns: int) -> PersistedSafety:
        words = f"the state file {self.path} is unreadable{why}: the car is on hold until somebody resumes it"
        self.damage = " ".join(words.split())
        return PersistedSafety(Hold(f"unreadable {self.path.name}{why}", now_ns))

    def _words(self, other: _OfLink, more: int) -> str:
        kept = [] if other.hold is None else [f"the hold of {other.hold.by}"]
        kept += [f"the e-stop of {estop.by}" for estop in other.estops]
        if other.loan is not None:
            kept.append(f"the loan to {other.loan.to}")
        verb = "belongs" if len(kept) == 1 else "belong"
        words = f"{' and '.join(kept)} {verb} to the car at {other.link}, not to the one at {self._link}"
        return printable(words + (f" (and those of {more} more links)" if more else ""), "?")


def _exchanged(
    others: tuple[_OfLink, ...], state: PersistedSafety, *, was: str, now: str
) -> tuple[tuple[_OfLink, ...], PersistedSafety]:
    """Put the state of the previous link (`was`) among the others, and take out the state of the new link (`now`)."""
    of_car = tuple(each for each in state.estops if not each.fleet_wide)
    of_fleet = tuple(each for each in state.estops if each.fleet_wide)
    mine = next((each for each in others if each.link == now), _OfLink(now, None, (), None))
    left = _OfLink(was, state.hold, of_car, state.loan)
    kept = [each for each in others if each.link not in (was, now)]
    if not left.is_empty:
        kept.append(left)
    state = replace(state, hold=mine.hold, loan=mine.loan, estops=of_fleet + mine.estops)
    return tuple(kept[-MAX_OTHER_LINKS:]), state


def _parse(content: Any, now_ns: int) -> PersistedSafety:
    """Return the state in a file, or raise one of `DAMAGE`. Older versions only wrote the hold."""
    return PersistedSafety(
        _hold(content["hold"], now_ns),
        _estops(content, now_ns),
        tuple(_text(each) for each in content.get("ended", ())),
        tuple(
            FleetPause(*_who_and_why(each), _past(each["at_ns"], now_ns), _rank(each))
            for each in content.get("pauses", ())
        ),
        tuple(_text(each) for each in content.get("ended_pauses", ())),
        _loan(content.get("loan"), now_ns),
    )


def _parse_others(content: Any, now_ns: int) -> Iterator[_OfLink]:
    """Yield the holds, e-stops and loans of other links. Raises the errors of `_parse`."""
    for each in content.get("others", ()):
        hold, loan = _hold(each["hold"], now_ns), _loan(each["loan"], now_ns)
        if not (other := _OfLink(_text(each["link"]), hold, _estops(each, now_ns), loan)).is_empty:
            yield other


def _hold(content: Any, now_ns: int) -> Hold | None:
    if content is None:
        return None
    return Hold(_text(content["by"]), _past(content["since_ns"], now_ns), _rank(content))


def _estops(content: Any, now_ns: int) -> tuple[Estop, ...]:
    return tuple(
        Estop(*_who_and_why(each), _past(each["at_ns"], now_ns), each["fleet_wide"] is True, _rank(each))
        for each in content.get("estops", ())
    )


def _who_and_why(content: Any) -> tuple[str, str, str]:
    return _text(content["id"]), _text(content["by"]), _text(content["why"])


def _loan(content: Any, now_ns: int) -> Loan | None:
    """Return the loan, or None if there is none, or if it is over or has no end."""
    if content is None:
        return None
    to, by, since_ns = _text(content["to"]), _text(content["by"]), _past(content["since_ns"], now_ns)
    loan = Loan(to, by, _rank(content), since_ns, float(content["duration_s"]))
    return loan if 0 < loan.left_s(now_ns) < inf else None


def _rank(content: Any) -> Rank:
    return Rank(content.get("rank", Rank.PERSON))


def _text(value: Any) -> str:
    text = str(value)
    text.encode()  # JSON can express half a surrogate pair, a protobuf message cannot
    return text


def _past(value: Any, now_ns: int) -> int:
    # If the clock was set back, a time in the future becomes now.
    return min(max(0, int(value)), now_ns)
