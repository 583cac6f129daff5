"""What a battery's voltage means: charge, level and what follows, with how far the estimate may be off.

Only of a voltage that is measured: a raspberry_pi car sends a constant (see `Profile.measured`).
"""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

EMPTY_V: Final = 6.4  # docs/reference/protocol.md#readings: two Li-ion cells, 6.4 V empty
FULL_V: Final = 8.4  # to 8.4 V full
LOW_V: Final = 7.0
CRITICAL_V: Final = 6.6
SAG_V: Final = 0.4
"""How far motors under load pull the voltage down; an estimate, not measured."""
RECOVERS_S: Final = 5.0
"""How long after a load the voltage may still rise; an estimate, not measured."""
CURVE: Final = 0.15
"""A Li-ion cell's curve is flat in the middle: a straight line between empty and full is off by about this share."""
HYSTERESIS_V: Final = 0.15
"""A level is left upwards only so far above its threshold."""
HOLD_S: Final = 5.0
"""A level changes when every reading for so long says so: one per second in mode 0, at most two seconds apart."""


class BatteryLevel(StrEnum):
    """Whether a person should do something."""

    OK = "ok"
    LOW = "low"
    CRITICAL = "critical"


class BatteryReaction(StrEnum):
    """What a level leads to."""

    WARN = "warn"
    REFUSE = "refuse"
    """No new drive and no new mode; what runs goes on."""
    STOP = "stop"
    """The same, and the car is stopped."""


@dataclass(frozen=True, slots=True)
class BatteryPolicy:
    """What each level leads to, and where it begins, V at rest.

    A brownout resets the car, which stops it, so nothing is stopped by default.
    """

    low: BatteryReaction = BatteryReaction.WARN
    critical: BatteryReaction = BatteryReaction.REFUSE
    low_v: float = LOW_V
    critical_v: float = CRITICAL_V

    def level(self, voltage_v: float) -> BatteryLevel:
        """The level of a voltage at rest, V."""
        if voltage_v < self.critical_v:
            return BatteryLevel.CRITICAL
        return BatteryLevel.LOW if voltage_v < self.low_v else BatteryLevel.OK

    def action(self, level: BatteryLevel | None) -> BatteryReaction | None:
        """What this level leads to; nothing if it is fine, or was never measured."""
        match level:
            case BatteryLevel.LOW:
                return self.low
            case BatteryLevel.CRITICAL:
                return self.critical
            case _:
                return None


@dataclass(slots=True)
class Battery:
    """The level of one car's battery, as its readings show it. Times are seconds on one monotonic clock."""

    policy: BatteryPolicy = field(default_factory=BatteryPolicy)
    level: BatteryLevel | None = None
    """None until a voltage was measured; then OK until readings have shown another level for HOLD_S."""
    voltage_v: float | None = None
    """As measured last."""
    heard_at: float = float("-inf")
    _loaded_at: float = float("-inf")
    _other: BatteryLevel | None = None
    _since: float = 0.0
    """Which other level the readings show, in the same direction since when."""

    def heard(self, voltage_v: float, *, loaded: bool, now: float) -> bool:
        """Take a measured voltage in; `loaded`: motors may be on. True if the level has changed."""
        self.voltage_v = voltage_v
        self.heard_at = now
        if loaded:
            self._loaded_at = now
        low_v, high_v = rest_v(voltage_v, loaded=self.loaded)
        worse, better = self.policy.level(high_v), self.policy.level(low_v - HYSTERESIS_V)
        if self.level is None:
            # Motors may have run until now, and a single reading may be damaged: the first one decides nothing.
            self.level = BatteryLevel.OK
        shown = self.level
        if _RANK[worse] > _RANK[shown]:
            shown = worse  # even if all of a load's sag is added
        elif _RANK[better] < _RANK[shown]:
            shown = better
        if shown is self.level:
            self._other = None
        elif self._other is None or (_RANK[self._other] > _RANK[self.level]) is not (_RANK[shown] > _RANK[self.level]):
            self._other, self._since = shown, now
        else:
            # Readings on both sides of `critical` are at least `low`: the level nearer to the present one has held.
            self._other = min(self._other, shown, key=lambda each: abs(_RANK[each] - _RANK[self.level or each]))
            if now - self._since >= HOLD_S:
                self.level, self._other = self._other, None
                return True
        return False

    @property
    def loaded(self) -> bool:
        """Whether the last voltage may be below what it is at rest."""
        return self.heard_at - self._loaded_at < RECOVERS_S

    @property
    def action(self) -> BatteryReaction | None:
        """What the level leads to."""
        return self.policy.action(self.level)

    @property
    def words(self) -> str:
        """The level, for a person; empty if nothing was measured."""
        if self.level is None or self.voltage_v is None:
            return ""
        share, error = charge(self.voltage_v, loaded=self.loaded)
        return f"battery {self.level}: {self.voltage_v:.2f} V, charge {share:.0%} +- {error:.0%}"

    @property
    def refusal(self) -> str:
        """Why no new drive or mode is allowed, for a person; empty if it is."""
        refuses = self.action in (BatteryReaction.REFUSE, BatteryReaction.STOP)
        return f"{self.words}: charge it, then drive; manual, stop, whistle and light work" if refuses else ""


_RANK: Final = {each: rank for rank, each in enumerate(BatteryLevel)}


def rest_v(voltage_v: float, *, loaded: bool) -> tuple[float, float]:
    """Between which two voltages, V, it would be without a load."""
    return voltage_v, voltage_v + (SAG_V if loaded else 0.0)


def charge(voltage_v: float, *, loaded: bool) -> tuple[float, float]:
    """Charge and the half width of its uncertainty, 0..1 each: a straight line between empty and full.

    Under a load it is taken from the middle of what the voltage may be at rest.
    """
    low_v, high_v = rest_v(voltage_v, loaded=loaded)
    share = ((low_v + high_v) / 2 - EMPTY_V) / (FULL_V - EMPTY_V)
    error = CURVE + (high_v - low_v) / 2 / (FULL_V - EMPTY_V)
    return min(1.0, max(0.0, share)), min(1.0, error)
