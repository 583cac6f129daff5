"""Persists the safety state of one car (its hold, its e-stops, the ended ones) in a small JSON file."""

import json
from pathlib import Path
from typing import Any

from gateway.control.safety import Estop, Hold, PersistedSafety
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
        hold = state.hold
        content = {
            "hold": None if hold is None else {"by": hold.by, "since_ns": hold.since_ns},
            "estops": [
                {"id": each.id, "by": each.by, "why": each.why, "at_ns": each.at_ns, "fleet_wide": each.fleet_wide}
                for each in state.estops
            ],
            "ended": list(state.ended),
        }
        write_atomically(self.path, json.dumps(content).encode(), sync=True)


def _parse(content: Any, now_ns: int) -> PersistedSafety:
    """Return the state in a file; raise ValueError, TypeError or KeyError. Older versions only have the hold."""
    hold = content["hold"]
    return PersistedSafety(
        None if hold is None else Hold(_text(hold["by"]), _past(hold["since_ns"], now_ns)),
        tuple(_estop(each, now_ns) for each in content.get("estops", ())),
        tuple(_text(each) for each in content.get("ended", ())),
    )


def _estop(content: Any, now_ns: int) -> Estop:
    identity, by, why = (_text(content[name]) for name in ("id", "by", "why"))
    return Estop(identity, by, why, _past(content["at_ns"], now_ns), content["fleet_wide"] is True)


def _text(value: Any) -> str:
    text = str(value)
    text.encode()  # JSON can express half a surrogate pair, a protobuf message cannot
    return text


def _past(value: Any, now_ns: int) -> int:
    # If the clock was set back, a time in the future becomes now.
    return min(max(0, int(value)), now_ns)
