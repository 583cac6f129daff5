"""What survives a restart of the gateway, in one small JSON file a car: who put it on hold, and since when."""

import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path

STATE_VARIABLE = "FLEET_STATE_DIR"


@dataclass(frozen=True, slots=True)
class StoredHold:
    """A hold; `since_ns`: ns since the epoch."""

    by: str
    since_ns: int


def default_directory() -> Path:
    """FLEET_STATE_DIR, else the user's state directory as the platform has it."""
    if chosen := os.environ.get(STATE_VARIABLE):
        return Path(chosen)
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Application Support" / "zenoh-car-fleet"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", str(Path.home()))) / "zenoh-car-fleet"
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "zenoh-car-fleet"


class Store:
    """The state file of one car."""

    def __init__(self, directory: Path, fleet: str, car: str) -> None:
        self.path = directory / f"{fleet}.{car}.json"

    def load(self, now_ns: int) -> StoredHold | None:
        """The hold that was in force; a file that cannot be read counts as one: better held than driven off."""
        try:
            text = self.path.read_text(encoding="utf-8")
        except FileNotFoundError:
            return None
        except (OSError, UnicodeDecodeError) as error:
            return StoredHold(f"unreadable {self.path.name}: {error}", now_ns)
        try:
            hold = json.loads(text)["hold"]
            if hold is None:
                return None
            by = str(hold["by"])
            by.encode()  # JSON can say half a surrogate pair, a message cannot
            return StoredHold(by, min(max(0, int(hold["since_ns"])), now_ns))
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
            return StoredHold(f"unreadable {self.path.name}", now_ns)

    def save(self, hold: StoredHold | None) -> None:
        """Write the file whole or not at all; raises OSError."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        content = {"hold": None if hold is None else {"by": hold.by, "since_ns": hold.since_ns}}
        scratch = self.path.with_suffix(".new")
        with scratch.open("w", encoding="utf-8") as file:
            json.dump(content, file)
            file.flush()
            os.fsync(file.fileno())
        scratch.replace(self.path)
