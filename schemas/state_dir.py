"""The directory of persisted state: e-stops, holds, runs with their logs, the state of coordinators."""

import os
import re
import sys
from pathlib import Path
from typing import Final

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
STATE_VARIABLE: Final = "FLEET_STATE_DIR"
JOINED_FILE: Final = "endpoint"
"""File in the state directory that names the joined hub."""
_LOCALHOST: Final = re.compile(r"(?<=/)localhost(?=:)")
_NOT_IN_NAME: Final = re.compile(r"[^a-z0-9.]+")
_NAME_LENGTH: Final = 64
_HASH_LENGTH: Final = 8


def joined_endpoint() -> str:
    """Return the endpoint of the hub that this user has joined (`fleet join`, `fleet up --secure`), or empty."""
    try:
        return (default_directory() / JOINED_FILE).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""


def default_directory() -> Path:
    """Return FLEET_STATE_DIR, else the user's state directory on this platform."""
    if chosen := os.environ.get(STATE_VARIABLE):
        return Path(chosen)
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Application Support" / "zenoh-car-fleet"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", str(Path.home()))) / "zenoh-car-fleet"
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "zenoh-car-fleet"


def directory_of(endpoint: str, directory: Path | None = None) -> Path:
    """Return the state directory of one bus, so that fleets of one name at two hubs do not share state."""
    # The default endpoint uses the directory itself, as all endpoints did in older versions, so that e-stops survive an
    # upgrade.
    directory = default_directory() if directory is None else directory
    endpoint = _LOCALHOST.sub("127.0.0.1", endpoint.lower())
    if endpoint == DEFAULT_ENDPOINT:
        return directory
    # The hash distinguishes endpoints with the same readable part, such as [::1] and a host named 1.
    readable = _NOT_IN_NAME.sub("-", endpoint)[:_NAME_LENGTH]
    import hashlib  # here, because the import takes 3 ms, which would delay a gateway's token

    return directory / "buses" / f"{readable}-{hashlib.sha256(endpoint.encode()).hexdigest()[:_HASH_LENGTH]}"
