"""What a coordinator leaves to the next one, in one small JSON file a fleet: roles, phase, rules in force.

It is a convenience, not the truth: what the cars are in counts for more (policy/memory.py). So a file that cannot be
read or written stops nobody.
"""

import contextlib
import json
from pathlib import Path
from typing import Any

from fleet.policy.state import PersistedPolicy
from schemas.state_dir import directory_of


class CoordinatorStateFile:
    """The file of one fleet at one endpoint. `run`: the `fleet up` that it belongs to; empty: none."""

    def __init__(self, fleet: str, endpoint: str, run: str) -> None:
        self._endpoint = endpoint
        self._run = run
        self._last = PersistedPolicy()
        self.path: Path | None = None
        with contextlib.suppress(RuntimeError):  # a user without a home
            self.path = directory_of(endpoint) / f"{fleet}.@coordinator.json"

    def load(self) -> PersistedPolicy:
        """What the last one left; nothing, if it cannot be read or was of another bus.

        Phase and rules count within one `fleet up`: with a new one the plan begins anew, and only the roles are kept.
        """
        if self.path is None:
            return PersistedPolicy()
        try:
            content: Any = json.loads(self.path.read_text(encoding="utf-8"))
            if content["endpoint"] != self._endpoint:
                return PersistedPolicy()
            roles = {str(car): str(role) for car, role in content["roles"].items()}
            if content.get("run", "") != self._run:
                return PersistedPolicy(roles=roles)
            return PersistedPolicy(
                str(content["version"]),
                roles,
                str(content["phase"]),
                float(content["phase_since_s"]),
                {int(index): str(that) for index, that in content["rules"].items()},
            )
        except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
            return PersistedPolicy()

    def save(self, kept: PersistedPolicy) -> None:
        """Write it, whole or not at all, if it has changed."""
        if self.path is None or _same(kept, self._last):
            return
        self._last = kept
        content = {
            "endpoint": self._endpoint,
            "run": self._run,
            "version": kept.version,
            "roles": dict(kept.roles),
            "phase": kept.phase,
            "phase_since_s": kept.phase_since_s,
            "rules": {str(index): that for index, that in kept.rules.items()},
        }
        scratch = self.path.with_suffix(".new")
        with contextlib.suppress(OSError):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            scratch.write_text(json.dumps(content), encoding="utf-8")
            scratch.replace(self.path)


def _same(one: PersistedPolicy, other: PersistedPolicy) -> bool:
    """Whether nothing but the clock's last digit has changed."""
    return (one.version, one.roles, one.phase, one.rules) == (other.version, other.roles, other.phase, other.rules)
