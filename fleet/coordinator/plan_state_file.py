"""Persists roles, phase and rules in force for the next coordinator, in one small JSON file per fleet.

The coordinator can do without the file, because it prefers cars that are already in the mode of a role
(policy/role_allocation.py). So no error of reading or writing ends it.
"""

import contextlib
import json
from pathlib import Path
from typing import Any, Final

from msgspec import to_builtins
from msgspec.structs import replace

from fleet.policy.state import PersistedPolicy
from schemas.atomic_file import DAMAGE, write_state
from schemas.state_dir import directory_of

MAX_CLOCK_NOISE_S: Final = 1.0
"""A phase's start on the wall clock may change by this much before the change counts as a step of that clock."""


class CoordinatorStateFile:
    """The file of one fleet at one endpoint. `run` is the name of its `fleet up` run, or empty without such a run."""

    def __init__(self, fleet: str, endpoint: str, run: str) -> None:
        self._endpoint = endpoint
        self._run = run
        self._last = PersistedPolicy()
        self.path: Path | None = None
        with contextlib.suppress(RuntimeError):  # a user without a home
            self.path = directory_of(endpoint) / f"{fleet}.@coordinator.json"

    def load(self) -> PersistedPolicy:
        """Return the persisted state, or an empty one if the file cannot be read or belongs to another bus.

        Phase and rules are restored only in a run of the same name, and coordinators that were started by hand all have
        the empty name. In another run, the plan starts again with the same roles.
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
                {int(index): str(trigger) for index, trigger in content["rules"].items()},
                str(content.get("stopped_by", "")),
                tuple(map(str, content.get("to_rest", ()))),
            )
        except (OSError, *DAMAGE):
            return PersistedPolicy()

    def save(self, state: PersistedPolicy) -> bool:
        """Write the state, whole or not at all, if it has changed. Return False if it cannot be written."""
        if self.path is None:
            return False
        if _same(state, self._last):
            return True
        content = {"endpoint": self._endpoint, "run": self._run, **to_builtins(state)}
        with contextlib.suppress(OSError):
            write_state(self.path, json.dumps(content))
            self._last = state
            return True
        return False


def _same(one: PersistedPolicy, other: PersistedPolicy) -> bool:
    """Return True if the states are equal, except for small changes of the start of the phase."""
    # After a step of the wall clock the start is written again. Otherwise a restarted coordinator would count the step
    # as time that passed.
    is_step = abs(one.phase_since_s - other.phase_since_s) > MAX_CLOCK_NOISE_S
    return not is_step and replace(one, phase_since_s=0.0) == replace(other, phase_since_s=0.0)
