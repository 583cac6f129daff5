"""What has come over one link: counts, and what each event says, for a person and for a script. No mode is judged."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from gateway.control.estimate.platform import PlatformDetector
from gateway.protocol.events import ArmReading, Echo, Event, ImuReading, Reject, Rejected, Sensors
from gateway.protocol.platforms import Profile, parse_platform


@dataclass(slots=True)
class LinkStatistics:
    """What has come over one link. Times in seconds since the start."""

    since: float | None = None
    until: float = 0.0
    bytes: int = 0
    kinds: Counter[str] = field(default_factory=Counter)
    rejects: Counter[str] = field(default_factory=Counter)
    modes: Counter[str] = field(default_factory=Counter)
    contradictions: Counter[str] = field(default_factory=Counter)
    looked_for: PlatformDetector = field(default_factory=lambda: PlatformDetector(parse_platform("unknown"), auto=True))

    def count(self, event: Event, profile: Profile) -> None:
        """Take an event in; `profile`: what the car was said to be."""
        self.looked_for.on_event(event)
        match event:
            case Sensors():
                self.kinds["sensors"] += 1
                self.modes[" or ".join(event.candidates)] += 1
                self.rejects.update(reject.cause for reject in event.rejects)
                self.contradictions.update(profile.contradictions(event))
            case ArmReading():
                self.kinds["arm"] += 1
                self.rejects.update(reject.cause for reject in event.rejects)
            case ImuReading():
                self.kinds["imu"] += 1
            case Echo():
                self.kinds["echo"] += 1
            case Rejected():
                self.rejects[event.cause] += 1

    @property
    def readings(self) -> int:
        """Good frames of a car; an echo of ours is none."""
        return self.kinds.total() - self.kinds["echo"]

    @property
    def seconds(self) -> float:
        """How long the link was listened to."""
        return max(0.0, self.until - (self.since or 0.0))

    def fields(self) -> dict[str, Any]:
        """For a script."""
        return {
            "frames": dict(self.kinds),
            "rejects": dict(self.rejects),
            "modes": dict(self.modes),
            "platform": self.looked_for.profile.name,
            "platform_evidence": self.looked_for.evidence[0],
            "contradictions": dict(self.contradictions),
            "bytes": self.bytes,
            "seconds": round(self.seconds, 3),
        }

    def words(self) -> str:
        """One line for a person."""
        heard = f"{self.readings} frames in {self.seconds:.1f} s"
        if self.seconds and self.readings:
            heard += f" ({self.readings / self.seconds:.1f}/s)"
        if not self.bytes:
            return f"{heard}: nothing came. Is the car on? In some modes, and while its fan runs, it is silent"
        if self.rejects:
            causes = ", ".join(f"{cause} {count}" for cause, count in self.rejects.most_common())
            heard += f", {self.rejects.total()} rejected ({causes})"
        if self.kinds["echo"]:
            heard += f", {self.kinds['echo']} echoes of what was sent"
        if self.modes:
            modes = ", ".join(mode if len(self.modes) == 1 else f"{mode} {n}" for mode, n in self.modes.most_common())
            heard += f"; mode by their shape: {modes}; platform: {self.looked_for.evidence[0]}"
        elif not self.readings and not self.kinds["echo"]:
            heard += ": no car of this protocol, or another baud rate"
        for words, count in self.contradictions.most_common():
            heard += f"; {count} times against the platform: {words}"
        return heard


def describe(event: Event, profile: Profile) -> dict[str, Any]:
    """What an event says: `kind`, and what was measured, as in the messages of the bus."""
    match event:
        case Sensors():
            return {"kind": "sensors", **_measured(event, profile)}
        case ArmReading():
            return {"kind": "arm", "joint_deg": list(event.joint_deg), **_rejected(event.rejects)}
        case ImuReading():
            return {"kind": "imu", "gyro_raw": list(event.gyro), "accel_raw": list(event.accel)}
        case Echo():
            return {"kind": "echo"}
        case Rejected():
            return {"kind": "rejected", "cause": event.cause, "detail": event.detail}


def _measured(event: Sensors, profile: Profile) -> dict[str, Any]:
    measured = profile.measured(event)
    fields: dict[str, Any] = {}
    if "range" in measured and event.range_cm is not None:
        fields |= {"range_m": round(event.range_cm / 100, 4)} if event.range_cm else {"no_echo": True}
    if "battery" in measured:
        fields["voltage_v"] = event.voltage_v
    if "grayscale" in measured:
        fields["grayscale"] = event.grayscale
    if "line" in measured:
        fields["line"] = _bits(event.line)
    if (obstacle := profile.obstacle(event)) is not None:
        fields["obstacle"] = _bits(obstacle)
    if "light" in measured:
        fields["light"] = _bits(event.light)
    fields["modes"] = list(event.candidates)
    if contradictions := profile.contradictions(event):
        fields["contradicts"] = list(contradictions)
    return fields | _rejected(event.rejects)


def _rejected(rejects: Sequence[Reject]) -> dict[str, Any]:
    return {"rejected": {reject.word: reject.text for reject in rejects}} if rejects else {}


def _bits(bits: Sequence[bool] | None) -> str:
    return "".join("1" if bit else "0" for bit in bits or ())
