"""Which program runs on the car, as far as its bytes show it: against the profile that was told, or to find one.

What bytes cannot show: an arduino from an stm32 (the same program, as far as it was read), and what a car does with
what it is sent, such as light 1, which a raspberry_pi car cycles. One damaged frame shows nothing: it takes three.
"""

from dataclasses import dataclass, field
from typing import Final

from gateway.protocol.enums import Mode
from gateway.protocol.events import ArmReading, Event, ImuReading, Sensors
from gateway.protocol.platforms import Platform, Profile, parse_platform

RUNNING: Final = 3
"""So many frames running show something, or no longer show it: there is no checksum, and one may be damaged."""

_MODES: Final = "readings of a mode other than 0, which raspberry_pi cars do not have"
_MEASURED: Final = "mode-0 readings with decimals in CSB, or without the constants PV8.4 and GS0 of a raspberry_pi car"
_CONSTANTS: Final = "mode-0 readings with PV8.4, GS0 and whole centimetres, the constants of a raspberry_pi car"
_WITH_MODES: Final = "arduino (or stm32: their bytes are the same)"


@dataclass(slots=True)
class _PlatformEvidence:
    """Words for something, and whether frames show it."""

    stands: bool = False
    _run: int = 0

    def weigh(self, *, shown: bool) -> bool:
        """Take one frame in that could show it; True if it stands from now on."""
        self._run = self._run + 1 if shown is not self.stands else 0
        if self._run < RUNNING:
            return False
        self._run = 0
        self.stands = shown
        return shown


@dataclass(slots=True)
class PlatformDetector:
    """The profile in force, and what speaks for and against it.

    With `auto` the profile is looked for: `profile` is the unknown one until the bytes show another.
    """

    told: Profile
    auto: bool = False
    profile: Profile = field(init=False)
    """What the car is treated as: what was told; with `auto` what it was settled on."""
    _against: dict[str, _PlatformEvidence] = field(default_factory=dict)
    _with_modes: str = ""
    _raspberry_pi: str = ""
    """What showed that it is one, in words; both are filled by a car that is none of those that are known."""
    _options: frozenset[str] = frozenset()
    _seen: dict[str, _PlatformEvidence] = field(
        default_factory=lambda: {word: _PlatformEvidence() for word in (_MODES, _MEASURED, _CONSTANTS)}
    )
    _frames: dict[str, int] = field(default_factory=lambda: {"arm": 0, "imu": 0})
    _more: set[str] = field(default_factory=set)
    """What speaks for an option that was not told."""

    def __post_init__(self) -> None:
        self.profile = self.told

    @property
    def contradictions(self) -> tuple[str, ...]:
        """What speaks against the profile now, in words."""
        return tuple(words for words, shown in self._against.items() if shown.stands)

    @property
    def doubted(self) -> bool:
        """Whether its sensors frames speak against the profile now; an option that was not told is no doubt."""
        return any(shown.stands for words, shown in self._against.items() if words not in self._more)

    @property
    def evidence(self) -> tuple[str, ...]:
        """Why the car is treated as it is, what speaks against it, and what of its profile was never observed."""
        return (*self._why(), *self.contradictions, *self.profile.not_observed)

    def heard(self, event: Event) -> tuple[str, ...]:
        """Take a frame in; what speaks against the profile from now on, in words. `profile` may be another after it."""
        match event:
            case Sensors():
                new = self._weigh(event)
                if self.auto:
                    self._look(event)
            case ArmReading() | ImuReading():
                new = self._count("arm" if isinstance(event, ArmReading) else "imu")
            case _:
                return ()
        return new

    def _weigh(self, event: Sensors) -> tuple[str, ...]:
        """What a sensors frame says of the profile. Only a frame of mode 0 shows what mode 0 looks like."""
        found = self.profile.contradictions(event)
        if not found and not self._against:
            return ()
        in_manual = event.signature is Mode.MANUAL
        for words in found:
            self._against.setdefault(words, _PlatformEvidence())
        weighed = [words for words in self._against if in_manual or words in found]
        new = tuple(words for words in weighed if self._against[words].weigh(shown=words in found))
        for words in weighed:
            if words not in found and not self._against[words].stands:
                del self._against[words]
        return new

    def _count(self, option: str) -> tuple[str, ...]:
        self._frames[option] += 1
        if self._frames[option] != RUNNING or option in self.profile.options:
            return ()
        if self.auto:
            self._options |= {option}
            self._settle()
            return ()
        words = f"{option} frames, which {self.profile.name} cars do not send: is it {self.profile.name}+{option}?"
        self._more.add(words)
        self._against[words] = _PlatformEvidence(stands=True)
        return (words,)

    def _look(self, event: Sensors) -> None:
        """Look for the platform: what has three frames running settles it, once."""
        if len(event.candidates) > 1:
            return
        in_manual = event.signature is Mode.MANUAL
        constants = b",PV8.4,GS0," in event.raw and b"." not in event.raw.partition(b",PV")[0]
        shown = {_MODES: not in_manual, _MEASURED: in_manual and not constants, _CONSTANTS: in_manual and constants}
        for words, seen in self._seen.items():
            if seen.weigh(shown=shown[words]):
                if words is _CONSTANTS:
                    self._raspberry_pi = words
                else:
                    self._with_modes = self._with_modes or words
                self._settle()

    def _settle(self) -> None:
        if bool(self._with_modes) is bool(self._raspberry_pi):
            kind = self.told.kind
        else:
            kind = Platform.ARDUINO if self._with_modes else Platform.RASPBERRY_PI
        profile = parse_platform("+".join((kind, *sorted(self._options | self.told.options))))
        if profile.name != self.profile.name:
            self.profile = profile
            self._against.clear()

    def _why(self) -> tuple[str, ...]:
        if not self.auto:
            return ()
        if self._with_modes and self._raspberry_pi:
            return (f"both {self._with_modes} and {self._raspberry_pi}: none of the platforms that are known",)
        if self._with_modes:
            return (f"{_WITH_MODES}: {RUNNING} {self._with_modes}",)
        if self._raspberry_pi:
            return (f"raspberry_pi: {RUNNING} {self._raspberry_pi}",)
        return (f"not settled: it takes {RUNNING} readings running",)
