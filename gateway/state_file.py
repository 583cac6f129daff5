"""What survives a restart of the gateway, in one small JSON file a car: its hold, its e-stops and the ended ones."""

import json
import os
from pathlib import Path
from typing import Any

from gateway.control.safety import Estop, Hold, PersistedSafety


class SafetyStateFile:
    """The state file of one car."""

    def __init__(self, directory: Path, fleet: str, car: str) -> None:
        self.path = directory / f"{fleet}.{car}.json"

    def load(self, now_ns: int) -> PersistedSafety:
        """What was in force; a file that cannot be read counts as a hold: better held than driven off."""
        try:
            text = self.path.read_text(encoding="utf-8")
        except FileNotFoundError:
            return PersistedSafety()
        except (OSError, UnicodeDecodeError) as error:
            return PersistedSafety(Hold(f"unreadable {self.path.name}: {error}", now_ns))
        try:
            return _kept(json.loads(text), now_ns)
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
            return PersistedSafety(Hold(f"unreadable {self.path.name}", now_ns))

    def save(self, kept: PersistedSafety) -> None:
        """Write the file whole or not at all; raises OSError."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        hold = kept.hold
        content = {
            "hold": None if hold is None else {"by": hold.by, "since_ns": hold.since_ns},
            "estops": [
                {"id": each.id, "by": each.by, "why": each.why, "at_ns": each.at_ns, "fleet_wide": each.fleet_wide}
                for each in kept.estops
            ],
            "ended": list(kept.ended),
        }
        scratch = self.path.with_suffix(".new")
        with scratch.open("w", encoding="utf-8") as file:
            json.dump(content, file)
            file.flush()
            os.fsync(file.fileno())
        scratch.replace(self.path)


def _kept(content: Any, now_ns: int) -> PersistedSafety:
    """Raises what a wrong type or a missing name raises. A file of an earlier version has only the hold."""
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
    text.encode()  # JSON can say half a surrogate pair, a message cannot
    return text


def _past(value: Any, now_ns: int) -> int:
    """A moment on the wall clock; a clock that was set back since makes none of the future."""
    return min(max(0, int(value)), now_ns)
