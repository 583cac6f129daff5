"""The messages of a page, checked and turned into command requests. Pure.

A page is not trusted. So each value is checked here, and the gateway decides whether the command is carried out.
"""

import json
from collections.abc import Callable, Mapping
from typing import Any, Final, Self

from msgspec import Struct
from msgspec.structs import replace

from fleet.client import commands
from schemas import keys
from schemas.commands import STOPPING_VERBS, STOPS, Verb
from schemas.words import Light, Mode, Motion, Scope, Servo, SpeedStep

MAX_CARS: Final = 128
"""Maximum number of cars in one message."""
_MAX_NUMBER: Final = 2**53
MOTIONS: Final = frozenset(str(motion) for motion in Motion if motion is not Motion.STOP)


class BadPageMessage(ValueError):
    """The message of a page is not allowed."""


class PageMessage(Struct, frozen=True):
    """One message of a page, with checked access to its fields."""

    fields: Mapping[str, Any]

    @classmethod
    def of(cls, text: str) -> Self:
        """Parse a message. Raises BadPageMessage."""
        try:
            fields = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise BadPageMessage(f"not JSON: {error}") from None
        if not isinstance(fields, dict):
            raise BadPageMessage("not a JSON object")
        return cls(fields)

    @property
    def needs_budget(self) -> bool:
        """True for a command to gateways that takes from the page's budget of commands when it arrives.

        A stop takes nothing. Whether a held drive key takes something, its own handler decides.
        """
        acts = self.kind == "do" and self.fields.get("verb") not in STOPS
        return acts or self.kind in ("take", "give_back", Verb.UNPAUSE)

    @property
    def kind(self) -> str:
        """The kind of the message. It says what the page wants."""
        return self.text("t", 16)

    def text(self, name: str, longest: int = 64) -> str:
        """Return the text of a field, empty without one. Raises BadPageMessage."""
        value = self.fields.get(name, "")
        if not isinstance(value, str) or len(value) > longest:
            raise BadPageMessage(f"{name} is not a text of at most {longest} characters")
        try:
            value.encode()
        except UnicodeEncodeError:  # the text has half of a surrogate pair
            raise BadPageMessage(f"{name} has invalid characters") from None
        return value

    def text_if_valid(self, name: str, longest: int = 64) -> str:
        """Return the text of a field, empty if it is not valid: a wrong detail must not make a stop fail."""
        try:
            return self.text(name, longest)
        except BadPageMessage:
            return ""

    @property
    def reason(self) -> str:
        """The reason of a stop, of any length. `estop_request` cuts and cleans it."""
        value = self.fields.get("why", "")
        return value if isinstance(value, str) else ""

    def number(self, name: str) -> int:
        """Return a whole number, 0 or more. Raises BadPageMessage."""
        value = self.fields.get(name)
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < _MAX_NUMBER:
            raise BadPageMessage(f"{name} is not a whole number from 0 to {_MAX_NUMBER - 1}")
        return value

    def cars(self) -> tuple[str, ...]:
        """Return names of cars, at least one. Raises BadPageMessage."""
        value = self.fields.get("cars")
        if not isinstance(value, list) or not 0 < len(value) <= MAX_CARS or not all(isinstance(e, str) for e in value):
            raise BadPageMessage(f"cars is not a list of 1 to {MAX_CARS} names")
        try:
            return tuple(dict.fromkeys(keys.check_name(name) for name in value))
        except keys.BadKey as error:
            raise BadPageMessage(str(error)) from None

    def stopped_cars(self) -> tuple[str, ...]:
        """Return the cars of a stop, at most `MAX_CARS`. Wrong names are left out: the others are stopped all the same.

        Raises BadPageMessage if no name is left.
        """
        value = self.fields.get("cars")
        listed = value if isinstance(value, list) else []
        names = dict.fromkeys(each for each in listed if isinstance(each, str) and keys.is_name(each))
        return tuple(names)[:MAX_CARS] or self.cars()

    def motion(self) -> str:
        """Return a motion that moves the car. Raises BadPageMessage."""
        return self.one_of("motion", MOTIONS)

    def one_of(self, name: str, allowed: frozenset[str]) -> str:
        """Return the text of a field. Raises BadPageMessage if it is not one of the `allowed`."""
        value = self.text(name)
        if value not in allowed:
            raise BadPageMessage(f"{name} {value!r} is not allowed")
        return value

    def _numbers(self, name: str, count: int) -> list[int]:
        value = self.fields.get(name)
        if not isinstance(value, list) or len(value) != count:
            raise BadPageMessage(f"{name} is not a list of {count} numbers")
        return [PageMessage({name: each}).number(name) for each in value]

    def request(self) -> commands.CommandRequest:
        """Return the command that the page wants. Raises BadPageMessage."""
        verb = self.text("verb", 16)
        build = _BUILDERS.get(verb)
        if build is None:
            raise BadPageMessage(f"the console has no command {verb!r}")
        try:
            request = build(self)
        except ValueError as error:
            raise BadPageMessage(str(error)) from None
        return replace(request, take=self.fields.get("take") is True)


def _mode(message: PageMessage) -> commands.CommandRequest:
    return commands.mode_request(message.one_of("mode", frozenset(map(str, Mode))))


def _led(message: PageMessage) -> commands.CommandRequest:
    red, green, blue = message._numbers("rgb", 3)
    return commands.led_request(red, green, blue)


def _light(message: PageMessage) -> commands.CommandRequest:
    return commands.light_request(message.one_of("light", frozenset(map(str, Light))))


def _servo(message: PageMessage) -> commands.CommandRequest:
    if message.fields.get("deg") is not None:
        return commands.servo_request(Servo.FRONT, deg=message.number("deg"))
    servo = message.one_of("servo", frozenset(map(str, Servo)))
    return commands.servo_request(
        servo, message.one_of("action", frozenset(move for each in Servo for move in each.moves))
    )


def _arm(message: PageMessage) -> commands.CommandRequest:
    return commands.arm_request(message._numbers("joint_deg", 6))


def _lend(message: PageMessage) -> commands.CommandRequest:
    return commands.lend_request(message.text("to"), float(message.number("duration_s")))


def _resume(message: PageMessage) -> commands.CommandRequest:
    ids = message.fields.get("ids", [])
    if not isinstance(ids, list) or len(ids) > MAX_CARS or not all(isinstance(each, str) for each in ids):
        raise BadPageMessage(f"ids is not a list of at most {MAX_CARS} ids")
    return commands.resume_request([each[:64] for each in ids])


def is_stop(text: str) -> bool:
    """Return True if a page's message stops cars, all or some."""
    try:
        message = PageMessage.of(text)
        return message.kind in STOPPING_VERBS or (message.kind == "do" and message.fields.get("verb") in STOPS)
    except BadPageMessage:
        return False


_BUILDERS: Final[Mapping[str, Callable[[PageMessage], commands.CommandRequest]]] = {
    Verb.MODE: _mode,
    Verb.LED: _led,
    Verb.LIGHT: _light,
    Verb.SERVO: _servo,
    Verb.ARM: _arm,
    Verb.RESUME: _resume,
    Verb.LEND: _lend,
    "end_loan": lambda _: commands.end_loan_request(),
    Verb.WHISTLE: lambda _: commands.plain_request(Verb.WHISTLE),
    Verb.SPEED: lambda message: commands.speed_request(message.one_of("step", frozenset(map(str, SpeedStep)))),
    Verb.FAN: lambda _: commands.fan_request(),
    Verb.FIND: lambda _: commands.plain_request(Verb.FIND),
    Verb.STOP: lambda _: commands.stop_request(),
    Verb.ESTOP: lambda message: commands.estop_request(message.reason, Scope.CAR),
}
