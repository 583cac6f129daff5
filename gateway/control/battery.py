"""Estimates charge and level of a battery from measured voltages, and defines the reaction to a level.

A raspberry_pi car sends a constant instead of a measured voltage (see `Profile.measured`).
"""

from copy import copy
from typing import Final

from msgspec import Struct, field
from msgspec.structs import replace

from schemas.battery_levels import CRITICAL_V, EMPTY_V, FULL_V, LOW_V
from schemas.words import BatteryAction, BatteryLevel

SAG_V: Final = 0.4
"""Maximum drop of the voltage while motors run. An estimate, not measured."""
LOAD_RECOVERY_S: Final = 5.0
"""Maximum time for which the voltage rises after a load. An estimate, not measured."""
CHARGE_ERROR: Final = 0.15
"""Error of the charge without a load. The estimate is linear, but the curve of a Li-ion cell is flat in the middle."""
TWO_CELLS_V: Final = 9.0
"""Voltage above which a battery must have more than two cells: two full cells have 8.4 V."""
HYSTERESIS_V: Final = 0.15
"""How far the voltage must rise above a threshold to end the lower level."""
LEVEL_DEBOUNCE_S: Final = 5.0
"""Time for which all readings must show another level before the level changes. In mode 0 a reading comes each
second."""


class BatteryPolicy(Struct, frozen=True):
    """The threshold of each level (V at rest, that is without a load, for two cells), and the reaction to each level.

    By default, the gateway stops the car at no level. If the voltage gets too low, the car resets, and stops by that.
    """

    on_low: BatteryAction = BatteryAction.WARN
    on_critical: BatteryAction = BatteryAction.REFUSE
    low_v: float = LOW_V
    critical_v: float = CRITICAL_V

    def level(self, voltage_v: float) -> BatteryLevel:
        """Return the level of a voltage (in V) without a load."""
        if voltage_v < self.critical_v:
            return BatteryLevel.CRITICAL
        return BatteryLevel.LOW if voltage_v < self.low_v else BatteryLevel.OK

    def of_cells(self, cells: int) -> "BatteryPolicy":
        """Return the policy for this number of cells, by scaling the thresholds, which are for two cells."""
        return replace(self, low_v=self.low_v * cells / 2, critical_v=self.critical_v * cells / 2)

    def action(self, level: BatteryLevel | None) -> BatteryAction | None:
        """Return the reaction to a level, or None if it is ok or unknown."""
        match level:
            case BatteryLevel.LOW:
                return self.on_low
            case BatteryLevel.CRITICAL:
                return self.on_critical
            case _:
                return None


class Battery(Struct):
    """The level of one car's battery. Times: s, monotonic."""

    policy: BatteryPolicy = field(default_factory=BatteryPolicy)
    cells: int = 2
    level: BatteryLevel | None = None
    """None until a voltage was measured, then OK until another level has lasted `LEVEL_DEBOUNCE_S`."""
    voltage_v: float | None = None
    """The last measured voltage."""
    measured_at: float = float("-inf")
    _loaded_at: float = float("-inf")
    _other: BatteryLevel | None = None
    """The level to which `level` will change: of those that the readings show since `_other_since`, the nearest one.
    None if the last reading showed `level` itself."""
    _other_since: float = 0.0
    """Since this time, all readings have shown worse levels than `level`, or all have shown better ones."""
    _rested_since: float | None = None
    """The time since which no reading may have been lowered by a load. None if the last one may have been."""
    _is_settled: bool = False
    """True once readings without a load have been coming for `LEVEL_DEBOUNCE_S`. Before that, an OK in `level` may be
    only what is assumed at the start."""

    def on_voltage(self, voltage_v: float, *, loaded: bool, now: float) -> bool:
        """Update the level with a measured voltage. Return True if it has changed.

        The first voltage sets the level to OK, which is not a change. With `loaded`, motors may be on.
        """
        self.voltage_v = voltage_v
        self.measured_at = now
        if loaded:
            self._loaded_at = now
        changed = self._update_level(voltage_v, now)
        if self.may_sag:
            self._rested_since = None
        elif self._rested_since is None:
            self._rested_since = now
        elif now - self._rested_since >= LEVEL_DEBOUNCE_S:
            self._is_settled = True
        return changed

    def after(self, voltage_v: float, *, loaded: bool, now: float) -> "Battery":
        """Return what `on_voltage` would make of this battery, which stays as it is."""
        battery = copy(self)
        battery.on_voltage(voltage_v, loaded=loaded, now=now)
        return battery

    def _update_level(self, voltage_v: float, now: float) -> bool:
        low_v, high_v = rest_v(voltage_v, loaded=self.may_sag)
        worse, better = self.policy.level(high_v), self.policy.level(low_v - HYSTERESIS_V)
        if self.level is None:
            # Conclude nothing from the first reading: motors may have run until now, or the reading may be corrupted.
            self.level = BatteryLevel.OK
        shown = self.level
        if _LEVEL_RANK[worse] > _LEVEL_RANK[shown]:
            shown = worse  # the level is worse even if a load causes the maximum drop
        elif _LEVEL_RANK[better] < _LEVEL_RANK[shown]:
            shown = better
        if shown is self.level:
            self._other = None
        elif self._other is None or (_LEVEL_RANK[self._other] > _LEVEL_RANK[self.level]) is not (
            _LEVEL_RANK[shown] > _LEVEL_RANK[self.level]
        ):
            self._other, self._other_since = shown, now
        else:
            # The readings may have shown different levels on this side of the current one, such as low and critical.
            # Take the level nearest to the current one: every one of these readings is at least as far away.
            self._other = min(
                self._other, shown, key=lambda each: abs(_LEVEL_RANK[each] - _LEVEL_RANK[self.level or each])
            )
            if now - self._other_since >= LEVEL_DEBOUNCE_S:
                self.level, self._other = self._other, None
                return True
        return False

    @property
    def may_sag(self) -> bool:
        """Return True if the last voltage may be below the voltage at rest, because of a load."""
        return self.measured_at - self._loaded_at < LOAD_RECOVERY_S

    @property
    def charge(self) -> tuple[float, float] | None:
        """Return the charge and its error, or None if it is not known.

        It is not known without a voltage, or if the voltage is too high for a battery of `cells` cells.
        """
        if self.voltage_v is None or self.voltage_v > TWO_CELLS_V * self.cells / 2:
            return None
        return charge(self.voltage_v, loaded=self.may_sag, cells=self.cells)

    @property
    def action(self) -> BatteryAction | None:
        """Return the reaction to the current level."""
        return self.policy.action(self.level)

    @property
    def words(self) -> str:
        """Return a text with level, voltage and charge. Empty if no voltage was measured."""
        if self.level is None or self.voltage_v is None:
            return ""
        share = "" if self.charge is None else ", charge {:.0%} +- {:.0%}".format(*self.charge)
        return f"battery {self.level}: {self.voltage_v:.2f} V{share}"

    @property
    def refusal(self) -> str:
        """Return why new drives and modes are refused, or an empty text if they are allowed."""
        action, words = self.action, self.words
        if not self._is_settled and self.voltage_v is not None:
            # A plan sets the mode of a car as soon as it can. In most modes, the car then reports no voltage any more,
            # so the level might never settle. Until it has, one bad reading is enough to refuse.
            shown = self.policy.level(self.voltage_v)
            if self.level is not None and _LEVEL_RANK[shown] > _LEVEL_RANK[self.level]:
                action = self.policy.action(shown)
                words = f"battery {shown} by its first readings: {self.voltage_v:.2f} V"
        refuses = action in (BatteryAction.REFUSE, BatteryAction.STOP)
        return f"{words}. Charge it before driving. Manual, stop, whistle and light still work." if refuses else ""


_LEVEL_RANK: Final = {each: rank for rank, each in enumerate(BatteryLevel)}


def rest_v(voltage_v: float, *, loaded: bool) -> tuple[float, float]:
    """Return the range of the voltage without a load, V."""
    return voltage_v, voltage_v + (SAG_V if loaded else 0.0)


def charge(voltage_v: float, *, loaded: bool, cells: int = 2) -> tuple[float, float]:
    """Return the charge and its error (half width), 0..1 each.

    The charge is taken to rise linearly with the voltage at rest, from `EMPTY_V` to `FULL_V`. Under a load, only a
    range of the voltage at rest is known. The charge is that of the middle of the range.
    """
    low_v, high_v = (each * 2 / cells for each in rest_v(voltage_v, loaded=loaded))
    share = ((low_v + high_v) / 2 - EMPTY_V) / (FULL_V - EMPTY_V)
    error = CHARGE_ERROR + (high_v - low_v) / 2 / (FULL_V - EMPTY_V)
    return min(1.0, max(0.0, share)), min(1.0, error)
