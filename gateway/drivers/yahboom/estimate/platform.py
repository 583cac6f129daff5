"""Detects from the car's bytes which program runs on it, and checks the bytes against the configured profile.

Two differences cannot be seen in the bytes. An arduino and an stm32 usually send the same bytes. And no car reports its
lights, so the bytes do not show that light 1 of a raspberry_pi car changes its color each time. A single frame may be
corrupted, so three in a row count.
"""

from dataclasses import dataclass, field
from typing import Final

from msgspec import Struct

from gateway.control.battery import TWO_CELLS_V
from gateway.control.driver import Rejected, TextLine
from gateway.drivers.yahboom.protocol.modes import candidate_modes, only_candidate
from gateway.drivers.yahboom.protocol.platforms import GRAY_10_BIT, Profile, parse_platform, pi_constants, whole_cm
from gateway.drivers.yahboom.protocol.sensors import Sensors, head_of
from gateway.drivers.yahboom.protocol.wire_events import ArmReading, Event, ImuReading
from schemas.platform_name import HEAD, NO_READINGS
from schemas.words import Mode, Platform

EVIDENCE_FRAMES: Final = 3
"""Number of consecutive frames that make or end evidence. A single one may be corrupted, as there is no checksum."""

OTHER_PROGRAM_FRAMES: Final = 12
"""Number of consecutive frames of another program, or with another head (first word of a frame), after which the car
counts as one with that program or head. The number is high for two reasons. A link that loses or changes bytes makes
such a frame now and then. And with a wrong head or platform, the car ignores every frame of ours that has a head. If no
frame with the head of the profile has arrived on this link, `EVIDENCE_FRAMES` with another head are enough."""

_MODE_READINGS: Final = "readings of a mode other than 0, which raspberry_pi cars do not have"
_MEASURED_READINGS: Final = "mode-0 readings with decimals in CSB, which raspberry_pi cars do not send"
_CONSTANT_READINGS: Final = "mode-0 readings with PV8.4, GS0 and whole centimeters, the constants of a raspberry_pi car"
_WIDE_READINGS: Final = "mode-0 readings with GS over 1023, of a 12-bit converter"
_WITH_MODES: Final = "arduino (or stm32: their bytes are usually the same)"


class _PlatformEvidence(Struct):
    """Makes one observation true or false only after several frames in a row that show it."""

    holds: bool = False
    _contrary: int = 0
    """Number of consecutive frames that show the opposite of `holds`."""

    def update(self, *, shown: bool) -> bool:
        """Count one frame. Return True if the observation holds from now on."""
        self._contrary = self._contrary + 1 if shown is not self.holds else 0
        if self._contrary < EVIDENCE_FRAMES:
            return False
        self._contrary = 0
        self.holds = shown
        return shown


@dataclass(slots=True)
class PlatformDetector:
    """The profile in force, and the evidence for and against it.

    With `auto` the detector sets `profile`, which is the unknown one at first.
    """

    configured: Profile
    auto: bool = False
    remembered: Profile | None = None
    """With `auto`: the profile with which a mode was opened that may still be open. Used until readings arrive."""
    profile: Profile = field(init=False)
    """The profile in force: the configured one, or with `auto` the detected one."""
    _found_contradictions: dict[str, _PlatformEvidence] = field(default_factory=dict)
    """Contradictions of the profile, in words, that hold or that some frames have shown."""
    _evidence_of_modes: str = ""
    _evidence_of_pi: str = ""
    """The evidence for a car with modes, and for a Raspberry Pi, in words. Empty if there is none. If there is evidence
    for both, the platform is unknown."""
    _one_kind_readings: int = 0
    """Number of consecutive readings that only one of the two kinds sends."""
    _one_kind_has_modes: bool = False
    _options: frozenset[str] = frozenset()
    """With `auto`: the options that were detected."""
    _observations: dict[str, _PlatformEvidence] = field(
        default_factory=lambda: {
            word: _PlatformEvidence()
            for word in (_MODE_READINGS, _MEASURED_READINGS, _CONSTANT_READINGS, _WIDE_READINGS)
        }
    )
    _is_wide: bool = False
    """True if the grayscale readings are those of an stm32 car."""
    _signs: dict[str, int] = field(default_factory=dict)
    """Number of frames that show an option, by option."""
    _open_mode: _PlatformEvidence = field(default_factory=_PlatformEvidence)
    _extra_options: set[str] = field(default_factory=set)
    """Contradictions that do not make the kind of the stop doubtful, such as an option that is not configured."""
    _readings: int = 0
    _assumed_silent: bool = False
    """True if the option `no_readings` of the profile comes from the silence of this link."""
    _is_heard: bool = False
    """True if readings have contradicted the option `no_readings`."""
    _other_head: str = ""
    _other_head_frames: int = 0
    """The first word of the last sensors frames, if this profile has another one, and the number of these frames."""
    _is_read: bool = False
    """True if a frame with the head of this profile has arrived on this link."""

    def __post_init__(self) -> None:
        self.profile = self.remembered or self.configured

    @property
    def contradictions(self) -> tuple[str, ...]:
        """Return the contradictions of the profile that hold now, in words."""
        return tuple(words for words, shown in self._found_contradictions.items() if shown.holds)

    @property
    def doubted(self) -> bool:
        """Return True if readings contradict the profile now. Contradictions by `note` do not count."""
        return any(
            shown.holds for words, shown in self._found_contradictions.items() if words not in self._extra_options
        )

    @property
    def open_mode(self) -> bool:
        """Return True if the last readings show a mode other than 0, so the car knows MODE frames."""
        return self._open_mode.holds

    @property
    def is_remembered(self) -> bool:
        """Return True if no reading of this link has shown the platform, so that the remembered one is used."""
        return self.profile is self.remembered

    @property
    def is_settled(self) -> bool:
        """Return True if the platform is known, or if so many readings have arrived that more would not show it."""
        return self.profile.kind is not Platform.UNKNOWN or self._readings > EVIDENCE_FRAMES

    def begin_link(self) -> None:
        """Forget the mode and the head that the readings of the last link showed."""
        self._open_mode = _PlatformEvidence()
        self._is_read, self._other_head_frames = False, 0

    @property
    def evidence(self) -> tuple[str, ...]:
        """Return the evidence for the profile, and its contradictions."""
        return (*self._evidence_for_profile(), *self.contradictions)

    def on_event(self, event: Event, *, counts: bool = True) -> tuple[str, ...]:
        """Update the evidence, and with `auto` the profile. Return new contradictions, in words.

        With `counts` False, use only the head of a reading.
        """
        if isinstance(event, Sensors):
            self._is_read, self._other_head_frames = True, 0
            if not counts:
                return ()
        match event:
            case Sensors():
                if not self.profile.has_readings:
                    return self._count_reading()
                self._open_mode.update(shown=Mode.MANUAL not in candidate_modes(event))
                new = self._check_profile(event)
                if self.auto:
                    self._detect(event)
                if event.voltage_v is not None and event.voltage_v > TWO_CELLS_V:
                    self._count_sign("3s")
            case ArmReading() | ImuReading():
                new = self._check_option("arm" if isinstance(event, ArmReading) else "imu")
            case TextLine():
                self._count_sign("text")
                return ()
            case Rejected(raw):
                return self._count_head(head_of(raw))
            case _:
                return ()
        return new

    def on_never_heard(self) -> str:
        """Treat a raspberry_pi car that has sent nothing on this link as one that never sends readings.

        The reports of such a car never show a stop, so only texts depend on this. Return the contradiction, in words.
        Return an empty text for any other car, because it may be in a silent mode.
        """
        if self.profile.kind is not Platform.RASPBERRY_PI or not self.profile.has_readings:
            return ""
        named = self.profile.name
        self.profile = _profile_of(self.profile.kind, self.profile.options | {NO_READINGS})
        self._assumed_silent = True
        return f"no readings, which {named} cars send. It is treated as {self.profile.name} until one arrives"

    def _count_reading(self) -> tuple[str, ...]:
        """Count a reading of a car that is treated as one without readings. The third reading ends this treatment.

        If the only reason for it was the silence of the car, the first reading is enough.
        """
        self._signs[NO_READINGS] = self._signs.get(NO_READINGS, 0) + 1
        if not self._assumed_silent and self._signs[NO_READINGS] < EVIDENCE_FRAMES:
            return ()
        named, was_named = self.profile.name, not self._assumed_silent
        self._assumed_silent, self._is_heard = False, True
        self.profile = _profile_of(self.profile.kind, self.profile.options - {NO_READINGS})
        words = f"readings, which {named} cars do not send. It is treated as {self.profile.name}"
        return (words,) if was_named and self.note(words) else ()

    def note(self, words: str) -> bool:
        """Add a contradiction that other evidence has shown. Return True if it is new."""
        if words in self._found_contradictions:
            return False
        self._extra_options.add(words)
        self._found_contradictions[words] = _PlatformEvidence(holds=True)
        return True

    def _count_sign(self, option: str) -> bool:
        """Count one frame that shows an option. Return True at the third one, if the profile lacks the option.

        With `auto`, the profile then gets the option.
        """
        self._signs[option] = self._signs.get(option, 0) + 1
        if self._signs[option] != EVIDENCE_FRAMES or option in self.profile.options:
            return False
        if self.auto:
            self._options |= {option}
            self._apply_evidence()
        return True

    def _check_profile(self, event: Sensors) -> tuple[str, ...]:
        """Update the contradictions of the profile. Only frames of mode 0 can end one."""
        observed = self.profile.contradictions(event)
        if not observed and not self._found_contradictions:
            return ()
        in_manual = only_candidate(event) is Mode.MANUAL
        for words in observed:
            self._found_contradictions.setdefault(words, _PlatformEvidence())
        judged = [words for words in self._found_contradictions if words not in self._extra_options]
        affected = [words for words in judged if in_manual or words in observed]
        new = tuple(words for words in affected if self._found_contradictions[words].update(shown=words in observed))
        for words in affected:
            if words not in observed and not self._found_contradictions[words].holds:
                del self._found_contradictions[words]
        return new

    def _check_option(self, option: str) -> tuple[str, ...]:
        """Count one frame of a part that a car has only with this option. Return the contradiction if it is new."""
        if not self._count_sign(option) or self.auto:
            return ()
        words = f"{option} frames, which {self.profile.name} cars do not send. Is it {self.profile.name}+{option}?"
        return (words,) if self.note(words) else ()

    def _count_head(self, head: str | None) -> tuple[str, ...]:
        """Count one sensors frame that does not begin with the head of this profile."""
        if head is None or head == self.profile.dialect.head:
            return ()
        self._other_head_frames = self._other_head_frames + 1 if head == self._other_head else 1
        self._other_head = head
        if self._other_head_frames != (OTHER_PROGRAM_FRAMES if self._is_read else EVIDENCE_FRAMES):
            return ()
        self._is_read = False
        option = f"{HEAD}={head}"
        if self.auto:
            self._options = _without_head(self._options) | {option}
            self._apply_evidence()
            return ()
        # Only cars with this head send such frames, so the configured head is wrong. With the configured one, no
        # reading could be decoded.
        named = self.profile.name
        self.profile = _profile_of(self.profile.kind, _without_head(self.profile.options) | {option})
        words = f"readings that begin with {head}, which {named} cars do not send. It is treated as {self.profile.name}"
        return (words,) if self.note(words) else ()

    def _detect(self, event: Sensors) -> None:
        """Detect the platform from the first evidence."""
        self._readings += 1
        if len(candidate_modes(event)) > 1:
            return
        in_manual = only_candidate(event) is Mode.MANUAL
        # Whole centimeters without the constants of a Raspberry Pi may come from a Raspberry Pi that measures its
        # battery, or from an stm32. A mode frame would end the Raspberry Pi's program, so such a car stays unknown.
        whole = whole_cm(event)
        shown = {
            _MODE_READINGS: not in_manual,
            _MEASURED_READINGS: in_manual and not whole,
            _CONSTANT_READINGS: in_manual and whole and pi_constants(event),
            _WIDE_READINGS: in_manual and event.grayscale is not None and event.grayscale > GRAY_10_BIT,
        }
        self._count_one_kind(
            with_modes=shown[_MODE_READINGS] or shown[_MEASURED_READINGS], pi=shown[_CONSTANT_READINGS]
        )
        for words, seen in self._observations.items():
            if seen.update(shown=shown[words]):
                if words is _CONSTANT_READINGS:
                    self._evidence_of_pi = words
                elif words is _WIDE_READINGS:
                    self._is_wide = True
                else:
                    self._evidence_of_modes = self._evidence_of_modes or words
                self._apply_evidence()

    def _count_one_kind(self, *, with_modes: bool, pi: bool) -> None:
        """Count a reading that only one kind sends. After many of them, drop the evidence for the other kind."""
        if with_modes is pi:
            self._one_kind_readings = 0
            return
        self._one_kind_readings = self._one_kind_readings + 1 if with_modes is self._one_kind_has_modes else 1
        self._one_kind_has_modes = with_modes
        if self._one_kind_readings != OTHER_PROGRAM_FRAMES or not (self._evidence_of_modes and self._evidence_of_pi):
            return
        if with_modes:
            self._evidence_of_pi = ""
        else:
            self._evidence_of_modes, self._is_wide = "", False
        self._apply_evidence()

    def forget(self) -> None:
        """Forget the evidence about the program, because another program is running."""
        self._evidence_of_modes = self._evidence_of_pi = ""
        self._is_wide, self._one_kind_readings, self._readings = False, 0, 0
        for words in self._observations:
            self._observations[words] = _PlatformEvidence()
        self._apply_evidence()

    def _apply_evidence(self) -> None:
        if bool(self._evidence_of_modes) is bool(self._evidence_of_pi):
            kind = self.configured.kind
        else:
            modes = Platform.STM32 if self._is_wide else Platform.ARDUINO
            kind = modes if self._evidence_of_modes else Platform.RASPBERRY_PI
        knows_head = any(each.startswith(HEAD) for each in self._options)
        configured = self.configured.options
        options = self._options | (_without_head(configured) if knows_head else configured)
        profile = _profile_of(kind, options - {NO_READINGS} if self._is_heard else options)
        if profile.name != self.profile.name:
            self.profile = profile
            self._found_contradictions.clear()

    def _evidence_for_profile(self) -> tuple[str, ...]:
        if not self.auto:
            return ()
        if self._evidence_of_modes and self._evidence_of_pi:
            return (f"both {self._evidence_of_modes} and {self._evidence_of_pi}: no known platform sends both",)
        if self._evidence_of_modes and self._is_wide:
            return (f"stm32: {EVIDENCE_FRAMES} {_WIDE_READINGS}",)
        if self._evidence_of_modes:
            return (f"{_WITH_MODES}: {EVIDENCE_FRAMES} {self._evidence_of_modes}",)
        if self._evidence_of_pi:
            return (f"raspberry_pi: {EVIDENCE_FRAMES} {self._evidence_of_pi}",)
        if self.is_remembered:
            return (f"{self.profile.name}: detected before a mode was opened, in which the car may still be",)
        return (f"not settled: {EVIDENCE_FRAMES} readings in a row are needed",)


def _profile_of(kind: Platform, options: frozenset[str]) -> Profile:
    return parse_platform("+".join((kind, *sorted(options))))


def _without_head(options: frozenset[str]) -> frozenset[str]:
    return frozenset(each for each in options if not each.startswith(HEAD))
