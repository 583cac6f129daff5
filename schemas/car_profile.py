"""The profile of a platform, in which its driver says what cars of this platform can do. `gateway.drivers` has them."""

from typing import Protocol

from schemas.words import Light, Mode, ServoAction


class CarProfile(Protocol):
    """Says what cars of one kind can do. There is one for each platform with its options, such as `arduino+arm`."""

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
        """The modes that the car may be in, whoever has switched them on."""

    @property
    def lights(self) -> frozenset[Light]:
        """The colors of the car's light."""

    @property
    def servos(self) -> frozenset[ServoAction]:
        """The actions that the car's servos can carry out."""

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
        """The time after which the car stops by itself without a new command, s. None if it drives on."""

    @property
    def not_observed(self) -> tuple[str, ...]:
        """Sentences about such cars that somebody has read or assumed, and nobody has observed. Empty without any."""

    @property
    def has_network(self) -> bool:
        """True if a TCP link ends at the car itself. False if it ends at a bridge, which runs on without clients."""

    def measurable(self, mode: Mode) -> frozenset[str]:
        """Return the names of all readings that the car can send in this mode: `range`, `battery`, `line`, ..."""

    def why_lacking(self, capability: str) -> str | None:
        """Return a sentence on why the car lacks a capability. None if the car has it, or if there is none such."""

    def hint(self, odd: str) -> str:
        """Return the likely cause of something odd in such cars, as a sentence. Empty if the driver knows none.

        `odd` is a finding of `fleet doctor` (`silent`, `not_obeyed`), or a field whose values are always out of range.
        """
