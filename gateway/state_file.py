"""Persists the safety state of one car (its hold, e-stops, pauses and loan) in a small JSON file."""

import json
from dataclasses import asdict
from math import inf
from pathlib import Path
from typing import Any

from gateway.control.people import SenderKind
from gateway.control.safety import Estop, FleetPause, Hold, Loan, PersistedSafety
from schemas.atomic_file import write_atomically


class SafetyStateFile:
    """The state file of one car."""

    def __init__(self, directory: Path, fleet: str, car: str) -> None:
        self.path = directory / f"{fleet}.{car}.json"

    def load(self, now_ns: int) -> PersistedSafety:
        """Return the persisted state. A corrupted file counts as a hold, so that the car does not drive off."""
        try:
            text = self.path.read_text(encoding="utf-8")
        except FileNotFoundError:
            return PersistedSafety()
        except (OSError, UnicodeDecodeError) as error:
            return PersistedSafety(Hold(f"unreadable {self.path.name}: {error}", now_ns))
        try:
            return _parse(json.loads(text), now_ns)
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
            return PersistedSafety(Hold(f"unreadable {self.path.name}", now_ns))

    def save(self, state: PersistedSafety) -> None:
        """Replace the file atomically; raise OSError."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(self.path, json.dumps(asdict(state)).encode(), sync=True)


def _parse(content: Any, now_ns: int) -> PersistedSafety:
    """Return the state in a file; raise ValueError, TypeError or KeyError. Older versions only have the hold."""
    hold, loan = content["hold"], content.get("loan")
    return PersistedSafety(
        None if hold is None else Hold(_text(hold["by"]), _past(hold["since_ns"], now_ns), _rank(hold)),
        tuple(
            Estop(*_who_and_why(each), _past(each["at_ns"], now_ns), each["fleet_wide"] is True, _rank(each))
            for each in content.get("estops", ())
        ),
        tuple(_text(each) for each in content.get("ended", ())),
        tuple(
            FleetPause(*_who_and_why(each), _past(each["at_ns"], now_ns), _rank(each))
            for each in content.get("pauses", ())
        ),
        tuple(_text(each) for each in content.get("ended_pauses", ())),
        None if loan is None else _loan(loan, now_ns),
    )


def _who_and_why(content: Any) -> tuple[str, str, str]:
    return _text(content["id"]), _text(content["by"]), _text(content["why"])


def _loan(content: Any, now_ns: int) -> Loan | None:
    """Return the loan; None if it is over."""
    to, by, since_ns = _text(content["to"]), _text(content["by"]), _past(content["since_ns"], now_ns)
    loan = Loan(to, by, _rank(content), since_ns, float(content["duration_s"]))
    return loan if 0 < loan.left_s(now_ns) < inf else None


def _rank(content: Any) -> SenderKind:
    return SenderKind(content.get("rank", SenderKind.PERSON))


def _text(value: Any) -> str:
    text = str(value)
    text.encode()  # JSON can express half a surrogate pair, a protobuf message cannot
    return text


def _past(value: Any, now_ns: int) -> int:
    # If the clock was set back, a time in the future becomes now.
    return min(max(0, int(value)), now_ns)
