"""Who commands the car, over time: whose liveliness token is gone, and whose stream of drives must pause first."""

from dataclasses import dataclass, field
from typing import Final

SENDER_GONE_S: Final = 1.0
"""A sender is lost when its token has been away so long: a restarted hub takes all tokens down for half a second."""
PAUSE_S: Final = 0.5
"""After a stop, whoever drives on and on is heard again when that has paused so long, or has said `stop`.

Without it the next sample of a stick that somebody still leans on would drive on, 50 ms after another person's stop.
"""
_REMEMBERED: Final = 256


@dataclass(slots=True)
class Senders:
    """Tokens and streams, by sender's name. Times are seconds on one monotonic clock."""

    _tokens: dict[str, float | None] = field(default_factory=dict)
    """None while the token is there; since when it is gone."""
    _drives: dict[str, tuple[float, bool]] = field(default_factory=dict)
    """When a sender's last drive came, and whether as a stream's."""
    _halted: set[str] = field(default_factory=set)

    # ------------------------------------------------------------------ tokens

    def appeared(self, name: str) -> None:
        """The sender's token is there."""
        self._tokens[name] = None

    def vanished(self, name: str, now: float, *, driving: bool) -> None:
        """A sender's liveliness token disappeared. Remember it only if that sender is driving.

        Changes are merged, so a token that came and went may be known only from its end.
        """
        if driving:
            self._tokens[name] = now
        else:
            self._tokens.pop(name, None)

    def lost_at(self, name: str) -> float:
        """When the sender counts as lost; inf while its token is there, or if it never was.

        A token need not be there before the first drive is: the bus may deliver them the other way round.
        """
        gone_at = self._tokens.get(name)
        return float("inf") if gone_at is None else gone_at + SENDER_GONE_S

    def forget(self, name: str) -> bool:
        """The sender drives no more: if its token is gone, so is what was remembered of it. True if it is gone."""
        gone = self._tokens.get(name) is not None
        if gone:
            del self._tokens[name]
        return gone

    # ------------------------------------------------------------------ who drives on and on

    def drives(self, name: str, now: float, *, streamed: bool, release: bool) -> bool:
        """Note a drive; False if it must not be obeyed: its sender has driven on and on since the car was stopped."""
        last, _ = self._drives.pop(name, (float("-inf"), False))
        if release or now - last >= PAUSE_S:
            self._halted.discard(name)
        self._drives[name] = now, streamed
        while len(self._drives) > _REMEMBERED:
            oldest = next(iter(self._drives))
            del self._drives[oldest]
            self._halted.discard(oldest)
        return name not in self._halted

    def halt(self, now: float, by: str = "") -> None:
        """The car was stopped: who has just driven must pause before it is heard again.

        Not who stopped it: a script that drives, stops and drives is no stick that somebody leans on. A stream is.
        """
        running = (
            name for name, (last, streamed) in self._drives.items() if now - last < PAUSE_S and (streamed or name != by)
        )
        self._halted.update(running)
