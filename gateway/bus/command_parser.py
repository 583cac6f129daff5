"""Parses a command query or publication into a `Command`, or raises an error that names the mistake.

The parser also checks ranges. `gateway.control.refusals` decides whether the command may be carried out now.
"""

import hashlib
import json
import math
import uuid
from collections.abc import Callable, Iterable
from typing import Any, Final, TypeVar

from msgspec.structs import replace

from gateway.bus.car_service import Request
from gateway.control.commands import (
    PLAIN_ACTIONS,
    Action,
    AimServo,
    ChangeSpeed,
    Command,
    Drive,
    EmergencyStop,
    EndLoan,
    Fan,
    Led,
    Lend,
    MoveArm,
    MoveServo,
    Pause,
    Resume,
    SetLight,
    SetMode,
    Signal,
    Stop,
    Unpause,
)
from schemas import messages
from schemas.commands import COMMANDS, STOPS, Verb
from schemas.identity import speaks_for
from schemas.limits import DEFAULT_MAX_DRIVE_S, MAX_NAME_LENGTH, MAX_REASON_LENGTH
from schemas.process.stdio import printable
from schemas.rights import Sender
from schemas.suggestion import did_you_mean
from schemas.topics import PROTOBUF
from schemas.words import FanState, Light, Mode, Motion, Rank, Reason, Scope, Servo, ServoAction, SpeedStep

W = TypeVar("W", bound=str)

COLOR_MAX: Final = 255
DEG_MAX: Final = 180
ARM_JOINTS: Final = 6
"""Maximum of a color, maximum of an angle in degrees, number of joints (docs/reference/keys.md#command-keys)."""
DEFAULT_DRIVE_S: Final = 0.5
"""Duration of a drive that names none, unless the car may only be driven for less."""
_SAME_QUERY_NS: Final = 2_000_000_000
"""Length of the periods of the wall clock in which equal e-stops count as one query (see `_id`)."""
_WIRE_KINDS: Final = tuple(kind for kind in Rank if kind is not Rank.LEAD)
"""The kinds of sender that a command may name. Only the fleet file says which person is a lead."""
# One query may send these verbs to several cars (docs/reference/keys.md#command-keys).
WILDCARD_VERBS: Final = tuple(verb for verb, row in COMMANDS.items() if row.wildcard)


class BadRequest(ValueError):
    """An invalid request. `command` has its readable part, so that the rejection is recorded with the command's id."""

    def __init__(self, reason: Reason, words: str, command: Command) -> None:
        super().__init__(words)
        self.reason = reason
        self.words = words
        self.command = command


def parse(
    request: Request, now_ns: int, *, car: str = "this car", longest_drive_s: float = DEFAULT_MAX_DRIVE_S
) -> Command:
    """Parse a request, or raise BadRequest. `now_ns` is the wall clock, ns since the epoch."""
    verb = request.verb
    blank = Command(_id(request, now_ns), verb, Sender(), Stop(), asked_ns=now_ns, streamed=request.streamed)
    if verb not in COMMANDS:
        words = f"{verb!r} is not a command. Commands: {', '.join(COMMANDS)}"
        raise BadRequest(Reason.UNSUPPORTED, words, blank)
    if request.by_wildcard and verb not in WILDCARD_VERBS:
        words = f"{verb} allows no wildcard: name one car (only {', '.join(WILDCARD_VERBS)} allow one)"
        raise BadRequest(Reason.BAD_VALUE, words, blank)
    if request.why_unread:
        if verb not in STOPS:
            raise BadRequest(Reason.BAD_VALUE, f"{verb}: {request.why_unread}", blank)
        return _stop_anyway(blank, request.why_unread, request)
    if request.payload is None and verb not in STOPS:
        words = f"{verb} has no payload: send {COMMANDS[verb].message} or its JSON (only stop and estop need none)"
        raise BadRequest(Reason.BAD_VALUE, words, blank)
    try:
        command = _parse_payload(blank, request, car, longest_drive_s)
    except BadRequest as error:
        if verb not in STOPS:
            raise
        command = _stop_anyway(error.command, error.words, request)
    return _proven(command, request.identity)


def _proven(command: Command, identity: str) -> Command:
    """Return the command if `identity`, which a certificate proves, may speak for its sender, else raise BadRequest.

    A stop in the name of somebody else is returned, too, but in the name of the certificate's owner.
    """
    sender = command.sender
    if not identity or speaks_for(identity, sender.name, sender.kind, command.verb):
        return command
    words = f"{identity} sent it in the name of {sender.name} ({sender.kind})"
    own = Sender(identity.partition(".")[2] or identity)
    if command.verb in STOPS:  # the car stops for everybody, but its hold must not name a false sender
        return replace(command, sender=own, note=f"the gateway stops the car in spite of an error: {words}")
    words = f"{command.verb}: {words}. Each certificate speaks for its owner only."
    raise BadRequest(Reason.NOT_ALLOWED, words, replace(command, sender=own))


def _stop_anyway(command: Command, words: str, request: Request) -> Command:
    """Return the stop for an invalid stop or e-stop, because the car must stop whatever the error is."""
    what = Stop() if request.verb == Verb.STOP else _readable_estop(request)
    return replace(command, what=what, note=f"the gateway stops the car in spite of an error: {words}")


def _id(request: Request, now_ns: int) -> str:
    """Return an id for a request without one. For an e-stop to several cars, all gateways should make the same id.

    They do unless it reaches them in different periods of `_SAME_QUERY_NS` by their wall clocks.
    """
    if request.verb != Verb.ESTOP or not request.by_wildcard:
        return uuid.uuid4().hex
    query = (request.payload or b"") + str(now_ns // _SAME_QUERY_NS).encode()
    return hashlib.sha256(query).hexdigest()[:32]


def _readable_estop(request: Request) -> EmergencyStop:
    """Return the readable part of an invalid e-stop: its scope and its reason."""
    try:
        fields = json.loads(request.payload or b"{}")
    except (ValueError, RecursionError):
        fields = None
    if not isinstance(fields, dict):
        try:
            message: Any = messages.parse(COMMANDS[Verb.ESTOP].message, request.payload or b"", _encoding(request))
        except messages.BadPayload:
            return EmergencyStop()
        fields = {"why": message.why, "scope": message.scope}
    why = fields.get("why")
    return EmergencyStop(_why(why) if isinstance(why, str) else "", fields.get("scope") == Scope.FLEET)


def _parse_payload(blank: Command, request: Request, car: str, longest_drive_s: float) -> Command:
    verb = blank.verb
    try:
        message: Any = messages.parse(COMMANDS[verb].message, request.payload or b"", _encoding(request))
    except messages.BadPayload as error:
        raise BadRequest(Reason.BAD_VALUE, f"{verb}: {error}", blank) from None
    command = blank
    try:
        command = replace(command, id=_text("id", message.id) or blank.id)
        command = replace(command, sender=Sender(_text("sender", message.sender, "/*$#?") or "anonymous"))
        kind = _word("kind", message.kind or Rank.SCRIPT, _WIRE_KINDS)
        command = replace(command, sender=Sender(command.sender.name, kind), take=message.take)
        ttl_s = _seconds("ttl_s", message.ttl_s, 3600.0) if message.HasField("ttl_s") else None
        what = _action(verb, message, car, longest_drive_s)
    except ValueError as error:
        raise BadRequest(Reason.BAD_VALUE, f"{verb}: {error}", command) from None
    return replace(
        command,
        what=what,
        age_s=_age_s(message, request, blank.asked_ns),
        ttl_s=ttl_s if ttl_s is not None else COMMANDS[verb].ttl_s,
    )


def _action(verb: str, message: Any, car: str, longest_drive_s: float) -> Action:
    """Return the action of a message. Raises ValueError for a wrong field."""
    if verb == Verb.DRIVE:
        return _drive(message, longest_drive_s, car)
    if verb in _WHAT:
        return _WHAT[verb](message)
    row = COMMANDS[verb]
    if row.signal:
        if not row.max_duration_s:
            return Signal(row.verb)
        return Signal(row.verb, _seconds("duration_s", message.duration_s, row.max_duration_s, row.min_duration_s))
    plain = PLAIN_ACTIONS[verb]
    return plain(**{name: getattr(message, name) for name in plain.__struct_fields__})


def _encoding(request: Request) -> str:
    if request.payload:
        return request.encoding
    return PROTOBUF  # zero bytes are a message without fields


def _age_s(message: Any, request: Request, now_ns: int) -> float | None:
    """Return the age of a request in s. None if it is unknown, negative if the sender's clock is ahead of ours."""
    if message.HasField("asked"):
        age_ns: int = now_ns - messages.stamp_ns(message.asked)
        return age_ns / 1e9
    if request.sampled_ns is None:
        return None
    # After the wall clock was set back, Zenoh's timestamps are ahead of it until it has caught up.
    return max(0.0, (now_ns - request.sampled_ns) / 1e9)


def _text(field: str, value: str, forbidden: str = "") -> str:
    """Check a name that states and files will contain. A sender's name is also part of the key of its token."""
    if set(value) & set(forbidden):
        raise ValueError(f"{field} {value!r} is not allowed: it must not contain any of {' '.join(forbidden)}")
    if not value.isprintable():
        raise ValueError(f"{field} {value!r} is not allowed: it must not contain control characters")
    if len(value) > MAX_NAME_LENGTH:
        raise ValueError(f"{field} of {len(value)} characters is too long: at most {MAX_NAME_LENGTH}")
    return value


def _word(field: str, value: str, allowed: Iterable[W]) -> W:
    """Return the allowed word that equals this value. Raises ValueError with the likely word, or with all words."""
    words = list(allowed)
    if value in words:
        return words[words.index(value)]
    problem = f"{field} {value!r}" if value else f"{field} is missing"
    near = did_you_mean(value, words)
    raise ValueError(f"{problem}. {near}" if near else f"{problem}: allowed are {', '.join(words)}")


def _lend(message: Any) -> Action:
    if message.end:
        if message.to or message.HasField("duration_s"):
            raise ValueError("end: give neither to nor duration_s")
        return EndLoan()
    to = _text("to", message.to, "/*$#?@")
    if not to:
        raise ValueError("to is missing: the person who gets the car")
    return Lend(to, _seconds("duration_s", message.duration_s, COMMANDS[Verb.LEND].max_duration_s))


def _resume(message: Any) -> Action:
    if message.all and message.ids:
        raise ValueError("all: give no ids")
    return Resume(tuple(message.ids), message.all)


def _seconds(field: str, value: float, top: float, bottom: float = 0.0) -> float:
    if not (math.isfinite(value) and 0 < value <= top and value >= bottom):
        least = f"at least {bottom:g}" if bottom else "more than 0"
        raise ValueError(f"{field} {value:g}: allowed are {least} and at most {top:g} s")
    return value


def _drive(message: Any, longest_s: float, car: str) -> Action:
    duration_s = min(DEFAULT_DRIVE_S, longest_s)
    if message.HasField("duration_s"):
        if longest_s < message.duration_s < math.inf:
            limit = f"at most {longest_s:g} s (longest_drive_s in its fleet file)"
            raise ValueError(f"{message.duration_s:g} s is longer than {car} may drive: {limit}")
        duration_s = _seconds("duration_s", message.duration_s, longest_s)
    return Drive(_word("motion", message.motion, Motion), duration_s, message.continues)


def _led(message: Any) -> Action:
    missing = [name for name in "rgb" if not message.HasField(name)]
    if missing:
        raise ValueError(f"{', '.join(missing)} is missing: r, g and b are needed, 0..255 each")
    return Led(*(_whole(name, getattr(message, name), COLOR_MAX) for name in "rgb"))


def _servo(message: Any) -> Action:
    if message.servo not in ("", *Servo):
        raise ValueError(f"servo {message.servo!r}: allowed are {', '.join(Servo)}")
    servo = Servo(message.servo or Servo.FRONT)
    if message.HasField("deg"):
        if servo is not Servo.FRONT or message.action:
            raise ValueError("deg: only the front servo turns to degrees. Send deg without an action")
        return AimServo(_whole("deg", message.deg, DEG_MAX))
    if message.action not in servo.moves:
        raise ValueError(
            f"action {message.action!r} of servo {servo}: allowed are {', '.join(servo.moves)}"
            + (", or deg 0..180" if servo is Servo.FRONT else "")
        )
    return MoveServo(ServoAction(f"{servo}_{message.action}"))


def _fan(message: Any) -> Action:
    if message.state not in ("", *FanState):
        raise ValueError(f"state {message.state!r}: allowed are on and off, or leave it out to toggle")
    return Fan(None if not message.state else message.state == FanState.ON)


def _estop(message: Any) -> Action:
    if message.scope not in ("", *Scope):
        raise ValueError(f"scope {message.scope!r}: allowed are car (the default) and fleet")
    return EmergencyStop(_why(message.why), message.scope == Scope.FLEET)


def _why(text: str) -> str:
    return printable(text, " ")[:MAX_REASON_LENGTH]


def _arm(message: Any) -> Action:
    joints = tuple(message.joint_deg)
    if len(joints) != ARM_JOINTS:
        raise ValueError(f"joint_deg: {len(joints)} values, allowed are {ARM_JOINTS}, each 0..{DEG_MAX}")
    return MoveArm(tuple(_whole(f"joint_deg[{index}]", each, DEG_MAX) for index, each in enumerate(joints)))


def _whole(field: str, value: int, top: int) -> int:
    if not 0 <= value <= top:
        raise ValueError(f"{field}: {value!r}, allowed are whole numbers 0..{top}")
    return value


_WHAT: Final[dict[str, Callable[[Any], Action]]] = {
    Verb.MODE: lambda message: SetMode(_word("mode", message.mode, Mode)),
    Verb.LED: _led,
    Verb.LIGHT: lambda message: SetLight(_word("light", message.light, Light)),
    Verb.SERVO: _servo,
    Verb.ARM: _arm,
    Verb.SPEED: lambda message: ChangeSpeed(_word("step", message.step, SpeedStep)),
    Verb.FAN: _fan,
    Verb.ESTOP: _estop,
    Verb.RESUME: _resume,
    Verb.PAUSE: lambda message: Pause(_why(message.why)),
    Verb.UNPAUSE: lambda message: Unpause(tuple(message.ids)),
    Verb.LEND: _lend,
}
"""Functions that make the action of a verb whose fields need rules. `drive` is not here: it also needs a limit."""
