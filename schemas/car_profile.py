"""The profile of a platform: its driver says in it what such cars can do. Pure; `gateway.drivers` has the profiles."""

from typing import Protocol

from schemas.words import Light, Mode, ServoAction


class CarProfile(Protocol):
    """Says what cars of one kind can do. There is one object for each name of a platform, with its options."""

    def __hash__(self) -> int:
        """Return a hash. Profiles are values: two profiles of the same name are equal."""

    @property
    def name(self) -> str:
        """The text in the fleet file, with its options: `arduino+arm`."""

    @property
    def capabilities(self) -> frozenset[str]:
        """The verbs that the car can carry out, and its parts such as `arm`, `imu`, `servo_vertical`."""

    @property
    def modes(self) -> frozenset[Mode]:
        """The modes that the car can be brought into. Every car has `Mode.MANUAL`."""

    @property
    def silent_modes(self) -> frozenset[Mode]:
        """The modes in which the car sends no readings."""

    @property
    def possible_modes(self) -> frozenset[Mode]:
        """The modes that the car may be in, whoever opened them."""

    @property
    def lights(self) -> frozenset[Light]:
        """The colors of the car's light."""

    @property
    def servos(self) -> frozenset[ServoAction]:
        """The steps of the car's servos."""

    @property
    def has_readings(self) -> bool:
        """False if the car never sends a reading."""

    @property
    def cells(self) -> int:
        """The number of cells of the car's battery."""

    @property
    def baud(self) -> int:
        """The rate of the car's UART, baud."""

    @property
    def dead_man_s(self) -> float | None:
        """The time after which the car stops by itself if nothing drives it, or None if it drives on."""

    @property
    def not_observed(self) -> tuple[str, ...]:
        """Sentences about such cars that were only read or assumed. Empty if everything was observed on a car."""

    @property
    def has_network(self) -> bool:
        """True if a TCP port is the car's own. False if it belongs to a bridge, which outlives its clients."""

    def measurable(self, mode: Mode) -> frozenset[str]:
        """Return the names of all readings that the car can send in this mode: `range`, `battery`, `line`, ..."""

    def why_lacking(self, capability: str) -> str | None:
        """Return a sentence on why the car lacks a capability. None if it has it, or if there is no such capability."""

    def hint(self, odd: str) -> str:
        """Return the likely cause of something odd in such cars, as a sentence. Empty if the platform has none.

        `odd` is a finding of `fleet doctor` (`silent`, `not_obeyed`), or a field whose values are always out of range.
        """
