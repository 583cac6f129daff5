"""The profile of cars of a plain family. It has a module of its own, because the driver loads slowly. Pure."""

from msgspec import Struct

from schemas.words import CAPABILITIES, Light, Mode, ServoAction


class PlainProfile(Struct, frozen=True):
    """Says what cars of one platform can do: a `CarProfile` without modes."""

    name: str
    capabilities: frozenset[str]
    """Words of `schemas.words.CAPABILITIES`."""
    measures: frozenset[str]
    """The sensor topics of the car, without `sensor/`."""
    lights: frozenset[Light] = frozenset()
    servos: frozenset[ServoAction] = frozenset()
    cells: int = 2
    """Number of cells of the battery. The level of the battery depends on it."""
    baud: int = 115200
    """Rate of the serial port."""
    dead_man_s: float | None = None
    """Time after which the car stops because no *motion* arrived, or None if there is no such time. A car with such a
    time gets no repeats of a stop that no reading shows. A car that only watches its link (a heartbeat, a closed
    connection) has none, because it drives on while the link is alive."""
    not_observed: tuple[str, ...] = ()
    """Facts that were read or assumed, but not seen on a car, as sentences."""
    has_network: bool = True
    """True if a TCP port is the car's own. False if it belongs to a bridge: `fleet check` may connect to a bridge."""
    hints: tuple[tuple[str, str], ...] = ()
    """The likely cause of a finding of `fleet doctor` (`silent`, `not_obeyed`) in such cars, as a sentence for each."""
    modes: frozenset[Mode] = frozenset({Mode.MANUAL})
    silent_modes: frozenset[Mode] = frozenset()

    @property
    def possible_modes(self) -> frozenset[Mode]:
        """The modes that the car may be in."""
        return self.modes

    @property
    def has_readings(self) -> bool:
        """False if the car never sends a reading."""
        return bool(self.measures)

    def measurable(self, mode: Mode) -> frozenset[str]:
        """Return the names of all readings that a car of this profile can send in this mode."""
        return self.measures if mode in self.modes else frozenset()

    def why_lacking(self, capability: str) -> str | None:
        """Return a sentence on why the car lacks a capability. None if it has it, or if there is no such capability."""
        known = capability in self.capabilities or capability not in CAPABILITIES
        return None if known else f"{self.name} cars have no {capability}"

    def hint(self, odd: str) -> str:
        """Return the likely cause of something odd in such cars, as a sentence. Empty if there is none."""
        return dict(self.hints).get(odd, "")
