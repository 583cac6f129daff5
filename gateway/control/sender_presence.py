"""Tracks senders: whose liveliness token is lost, and who must send no drive for a while after a stop.

A sender may have a liveliness token on the bus, which disappears with its connection (see `schemas.keys`).
"""

from typing import Final

from msgspec import Struct, field

from schemas.limits import STREAM_SILENCE_S

SENDER_GONE_S: Final = 1.0
"""Timeout for a lost token. During a restart of the hub, all tokens disappear for half a second."""
MAX_SENDERS: Final = 256
"""Maximum senders whose last drive is remembered."""


class Senders(Struct):
    """Tokens and drive streams, by name of the sender. Times: s, monotonic."""

    _tokens: dict[str, float | None] = field(default_factory=dict)
    """When each token disappeared. None while it exists."""
    _drives: dict[str, tuple[float, bool]] = field(default_factory=dict)
    """When the last drive of each sender arrived, and True if it was a sample of a stream."""
    _halted: set[str] = field(default_factory=set)
    """The senders whose drives are refused until they have sent none for `STREAM_SILENCE_S`."""

    # ------------------------------------------------------------------ tokens

    def on_token(self, name: str) -> None:
        """Record that the sender's token exists."""
        self._tokens[name] = None

    def on_token_lost(self, name: str, now: float, *, driving: bool) -> None:
        """Record that the sender's token disappeared, but only if that sender is driving."""
        # The bus merges changes, so a token may disappear without having appeared here.
        if driving:
            self._tokens[name] = now
        else:
            self._tokens.pop(name, None)

    def lost_at(self, name: str) -> float:
        """Return when the sender counts as lost, or inf if its token exists, or never did."""
        # The bus may deliver the first drive before the token.
        gone_at = self._tokens.get(name)
        return float("inf") if gone_at is None else gone_at + SENDER_GONE_S

    def forget(self, name: str) -> bool:
        """Drop a lost token after the sender's drive. Return True if the token was lost."""
        is_lost = self._tokens.get(name) is not None
        if is_lost:
            del self._tokens[name]
        return is_lost

    # ------------------------------------------------------------------ drive streams

    def on_drive(self, name: str, now: float, *, streamed: bool, release: bool) -> bool:
        """Record a drive, or with `release` its end. Return False if the sender must send none for a while first."""
        last, _ = self._drives.pop(name, (float("-inf"), False))
        if release or now - last >= STREAM_SILENCE_S:
            self._halted.discard(name)
        self._drives[name] = now, streamed
        while len(self._drives) > MAX_SENDERS:
            oldest = next(iter(self._drives))
            del self._drives[oldest]
            self._halted.discard(oldest)
        return name not in self._halted

    def halt(self, now: float, by: str = "") -> None:
        """Refuse each sender that has just driven, until it has been silent, because the car was stopped."""
        # The sender of the stop is exempt, unless it streams: a script may stop and drive again, a held joystick may
        # not.
        self._halted.update(
            name
            for name, (last, streamed) in self._drives.items()
            if now - last < STREAM_SILENCE_S and (streamed or name != by)
        )

    def halt_streams(self, now: float) -> None:
        """Refuse each stream until it has been silent, because the car was lost.

        Otherwise a joystick that was held before the car was lost would drive the car when it is back. A script sends
        a drive once, and that drive has ended with the link.
        """
        self._halted.update(
            name for name, (last, streamed) in self._drives.items() if streamed and now - last < STREAM_SILENCE_S
        )

    def skip(self, slept_s: float) -> None:
        """Do not count a sleep of the computer as silence of a stream, if the clock runs on during the sleep."""
        self._drives = {name: (last + slept_s, streamed) for name, (last, streamed) in self._drives.items()}
