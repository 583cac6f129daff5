"""How much one page, one device and one person may ask of the console. Pure: time is an argument (s, monotonic).

The console stops the cars for everybody, on one loop. So a page that sends again and again must not slow down the
others. Each has a budget far above what our own page can send, and a page that exceeds its budget is closed. STOP has
no budget here: repeated STOPs are merged and never dropped, and a page that was closed still stops all cars by POST.
"""

from collections import Counter
from collections.abc import Hashable
from typing import Final

from msgspec import Struct, field

from schemas.token_bucket import TokenBucket

# Our page sends 10 echoes a second (answers to ticks, see `hold_to_drive`) while a finger is down, and a few messages
# for each press. After 30 s of slow Wi-Fi it may send some 450 at once. The limits are ten times that.
PAGE_BURST: Final = 5000.0
PAGE_RATE: Final = 160.0
"""Messages of one page: at once, and per second."""
DEVICE_BURST: Final = 10_000.0
DEVICE_RATE: Final = 320.0
"""Messages of all pages of one device: at once, and per second."""
REQUEST_BURST: Final = 1000.0
REQUEST_RATE: Final = 50.0
"""HTTP requests of one device other than STOP: a page loads some 25 files."""
CHECK_BURST: Final = 20.0
CHECK_RATE: Final = 1.0
"""Checks of plans by one person. A person who writes a plan asks for one check in ten seconds."""
MAX_OPEN_CHECKS: Final = 2
"""Maximum number of checks of one person that wait. They delay the checks of other persons."""
COOLDOWN_S: Final = 15.0
"""Time for which a device whose page was closed cannot open another page."""
# A person clicks about twice a second. After 30 s of slow Wi-Fi, 60 commands arrive at once. The rate allows ten times
# as much as a person, but the burst only three times the 60, because each command costs time in every gateway that it
# asks.
COMMAND_BURST: Final = 200.0
COMMAND_RATE: Final = 20.0
"""Commands of a device that ask gateways, at once and per second. A press counts once for
each direction."""
MAX_OPEN_COMMANDS: Final = 16
"""Maximum number of commands of one device that have no outcome yet. One command may be for many cars."""
MAX_BUDGETS: Final = 1024
"""Maximum number of remembered persons, devices and strangers. Beyond it, the one that was idle the longest is
forgotten."""
MERGE_S: Final = 0.1
"""Time within which further STOPs of one person are merged into one, which is sent at the end of that time."""
TOO_MUCH: Final = "This page has sent far more than a person can. STOP still works; it connects again in 15 s."

TOO_MANY_PLANS: Final = "Too many plans of this person wait for a check. Try again in a few seconds."


def page_budget() -> TokenBucket:
    """Return the budget of messages of a new page."""
    return TokenBucket(PAGE_RATE, PAGE_BURST)


class _Budget(Struct):
    messages: TokenBucket
    requests: TokenBucket
    checks: TokenBucket
    commands: TokenBucket
    closed_until: float = float("-inf")


class Budgets(Struct):
    """The budgets of persons by name, of devices by id (None means this computer), and of strangers by address."""

    _all: dict[Hashable, _Budget] = field(default_factory=dict)
    _open: Counter[Hashable] = field(default_factory=Counter)
    """Number of commands without an outcome, by device."""

    def may_send(self, device: Hashable, page: TokenBucket, now: float) -> bool:
        """Count a message.

        Return False if the page has to be closed because the page or its device has sent too many.
        """
        one = self._of(device)
        if page.take_one(now) and one.messages.take_one(now):
            return True
        one.closed_until = now + COOLDOWN_S
        return False

    def may_open(self, device: Hashable, now: float) -> bool:
        """Return False if a page of this device was closed a moment ago."""
        return now >= self._of(device).closed_until

    def may_ask(self, device: Hashable, now: float) -> bool:
        """Count an HTTP request. Return False if there were too many."""
        return self._of(device).requests.take_one(now)

    def may_check(self, person: Hashable, now: float) -> bool:
        """Count a check of a plan. Return False if there were too many."""
        return self._of(person).checks.take_one(now)

    def may_command(self, device: Hashable, now: float) -> bool:
        """Count a command that asks gateways. Return False if there were too many."""
        return self._of(device).commands.take_one(now)

    def may_open_command(self, device: Hashable) -> bool:
        """Return False if too many commands of this device have no outcome yet."""
        return self._open[device] < MAX_OPEN_COMMANDS

    def on_command_begun(self, device: Hashable) -> None:
        """Count a command that has no outcome yet. `on_command_ended` must follow."""
        self._open[device] += 1

    def on_command_ended(self, device: Hashable) -> None:
        """Handle the outcome of a command that was counted."""
        self._open[device] -= 1
        if not self._open[device]:
            del self._open[device]

    def _of(self, whose: Hashable) -> _Budget:
        found = self._all.pop(whose, None)
        if found is None:
            found = _Budget(
                TokenBucket(DEVICE_RATE, DEVICE_BURST),
                TokenBucket(REQUEST_RATE, REQUEST_BURST),
                TokenBucket(CHECK_RATE, CHECK_BURST),
                TokenBucket(COMMAND_RATE, COMMAND_BURST),
            )
        self._all[whose] = found
        if len(self._all) > MAX_BUDGETS:
            del self._all[next(iter(self._all))]
        return found


class StopMerge(Struct):
    """Merges the STOPs of one person. The first is sent at once. All others within MERGE_S become one more STOP."""

    _open_at: float = float("-inf")

    def delay_s(self, now: float) -> float | None:
        """Return the delay of this STOP, which may be 0. None means that a STOP that already waits replaces it."""
        if now >= self._open_at:
            self._open_at = now + MERGE_S
            return 0.0
        if self._open_at > now + MERGE_S:
            return None
        wait_s = self._open_at - now
        self._open_at += MERGE_S
        return wait_s
