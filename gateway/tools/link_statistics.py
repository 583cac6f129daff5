"""Counts the events of one link and describes them for a person or a script."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

from msgspec import Struct, field

from gateway.control.driver import Echo, Rejected, TextLine
from gateway.drivers.yahboom.estimate.platform import PlatformDetector
from gateway.drivers.yahboom.protocol.measurements import measured
from gateway.drivers.yahboom.protocol.modes import candidate_modes
from gateway.drivers.yahboom.protocol.platforms import Profile, parse_platform
from gateway.drivers.yahboom.protocol.sensors import RejectedField, Sensors
from gateway.drivers.yahboom.protocol.wire_events import ArmReading, Event, ImuReading
from schemas.words import FrameVerdict, Platform


class LinkStatistics(Struct):
    """Counts of the events of one link. Times are in seconds from any origin."""

    since: float | None = None
    until: float = 0.0
    bytes: int = 0
    kinds: Counter[str] = field(default_factory=Counter)
    rejects: Counter[str] = field(default_factory=Counter)
    modes: Counter[str] = field(default_factory=Counter)
    contradictions: Counter[str] = field(default_factory=Counter)
    detector: PlatformDetector = field(
        default_factory=lambda: PlatformDetector(parse_platform(Platform.UNKNOWN), auto=True)
    )

    def count(self, event: Event, profile: Profile) -> None:
        """Count an event. `profile` is the configured platform."""
        self.detector.on_event(event)
        match event:
            case Sensors():
                self.kinds[FrameVerdict.SENSORS] += 1
                self.modes[" or ".join(candidate_modes(event))] += 1
                self.rejects.update(reject.cause for reject in profile.rejects(event))
                self.contradictions.update(profile.contradictions(event))
            case ArmReading():
                self.kinds[FrameVerdict.ARM] += 1
                self.rejects.update(reject.cause for reject in event.rejects)
            case ImuReading():
                self.kinds[FrameVerdict.IMU] += 1
            case Echo():
                self.kinds[FrameVerdict.ECHO] += 1
            case TextLine():
                self.kinds[FrameVerdict.TEXT] += 1
            case Rejected():
                self.rejects[event.cause] += 1

    @property
    def readings(self) -> int:
        """The number of good frames, without echoes and lines of text."""
        return self.kinds.total() - self.kinds[FrameVerdict.ECHO] - self.kinds[FrameVerdict.TEXT]

    @property
    def seconds(self) -> float:
        """The time for which the link was open."""
        return max(0.0, self.until - (self.since or 0.0))

    def fields(self) -> dict[str, Any]:
        """Return the counts for a script."""
        return {
            "frames": dict(self.kinds),
            "rejects": dict(self.rejects),
            "modes": dict(self.modes),
            "platform": self.detector.profile.name,
            "platform_evidence": self.detector.evidence[0],
            "contradictions": dict(self.contradictions),
            "bytes": self.bytes,
            "seconds": round(self.seconds, 3),
        }

    def words(self) -> str:
        """Return the counts as one line for a person."""
        text = f"{self.readings} frames in {self.seconds:.1f} s"
        if self.seconds and self.readings:
            text += f" ({self.readings / self.seconds:.1f}/s)"
        if not self.bytes:
            return f"{text}: no byte arrived. Is the car on? In some modes, and while its fan runs, it is silent"
        if self.rejects:
            causes = ", ".join(f"{cause} {count}" for cause, count in self.rejects.most_common())
            text += f", {self.rejects.total()} rejected ({causes})"
        if self.kinds[FrameVerdict.ECHO]:
            text += f", {self.kinds[FrameVerdict.ECHO]} echoes of sent frames"
        if self.kinds[FrameVerdict.TEXT]:
            text += f", {self.kinds[FrameVerdict.TEXT]} lines of text"
        if self.modes:
            modes = ", ".join(mode if len(self.modes) == 1 else f"{mode} {n}" for mode, n in self.modes.most_common())
            text += f"; mode, by the form of the frames: {modes}; platform: {self.detector.evidence[0]}"
        elif not self.readings and not self.kinds[FrameVerdict.ECHO]:
            text += ": this is no car of this protocol, or the baud rate is wrong"
        for words, count in self.contradictions.most_common():
            text += f"; contradicts the platform {count} times: {words}"
        return text


def describe(event: Event, profile: Profile) -> dict[str, Any]:
    """Return the kind of an event and its measurements, in the units of the messages."""
    match event:
        case Sensors():
            return {"kind": FrameVerdict.SENSORS, **_measured(event, profile)}
        case ArmReading():
            return {"kind": FrameVerdict.ARM, "joint_deg": list(event.joint_deg), **_rejected(event.rejects)}
        case ImuReading():
            return {"kind": FrameVerdict.IMU, "gyro_raw": list(event.gyro), "accel_raw": list(event.accel)}
        case Echo():
            return {"kind": FrameVerdict.ECHO}
        case TextLine():
            return {"kind": FrameVerdict.TEXT}
        case Rejected():
            return {"kind": "rejected", "cause": event.cause, "detail": event.detail}


def _measured(event: Sensors, profile: Profile) -> dict[str, Any]:
    fields: dict[str, Any] = {}
    for topic, values in measured(event, profile, None).items():
        match topic.removeprefix("sensor/"):
            case "range":
                fields |= {"no_echo": True} if values["no_echo"] else {"range_m": values["range_m"]}
            case "line" | "obstacle" | "light" as name:
                fields[name] = "".join("1" if bit else "0" for bit in values.values())
            case "grayscale":
                fields["grayscale"] = values["raw"]
            case _:
                fields |= values
    fields["modes"] = list(candidate_modes(event))
    if contradictions := profile.contradictions(event):
        fields["contradicts"] = list(contradictions)
    return fields | _rejected(profile.rejects(event))


def _rejected(rejects: Sequence[RejectedField]) -> dict[str, Any]:
    return {"rejected": {reject.word: reject.text for reject in rejects}} if rejects else {}
