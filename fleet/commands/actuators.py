"""`fleet led, light, servo, arm, speed, fan`, and others, such as `whistle`.

The others have no function here: they are made from their rows in `schemas.commands`.
"""

import re
from typing import Any, Final

import click

from fleet.client.client import Fleet
from fleet.client.commands import (
    CommandRequest,
    arm_request,
    fan_request,
    led_request,
    light_request,
    plain_request,
    servo_request,
    speed_request,
)
from fleet.commands.car_names import CarNames, cars_argument
from fleet.commands.exit_code import carry_out
from fleet.commands.options import json_option, take_option, with_client
from fleet.commands.params import Choice, Color, Duration, describe_usage
from schemas.commands import COMMANDS, CommandType
from schemas.suggestion import misspelled
from schemas.words import FanState, Light, Servo, SpeedStep

_NEGATIVE_NUMBERS: Final = {"ignore_unknown_options": True}
"""Context settings with which -1 is a wrong value and not an unknown option."""
_ARM_EXAMPLE: Final = "fleet arm red 90 90 45 120 90 30"


class _LightColor(Color):
    """A color of the light, or any other color, which only the LED can show."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the request for the lamp that can show the color."""
        if value in list(Light):
            return light_request(value)
        return led_request(*super().convert(value, param, ctx))


def _servo(ctx: click.Context, _: click.Parameter, action: str | None) -> CommandRequest:
    """Return the request for an action of the servo. Reject a wrong action before any query."""
    servo = Servo(ctx.params["servo"])
    if action is None or not re.fullmatch("[0-9]+", action):
        allowed = servo.moves
        words = f"servo {servo}: {', '.join(allowed)}{' or 0 to 180 degrees' if servo is Servo.FRONT else ''}"
        if action is None:
            raise click.BadParameter(f"say what {words} should do, as: fleet servo red {servo} {allowed[0]}")
        if action not in allowed:
            raise click.BadParameter(f"{action!r} is not allowed for {words}")
        return servo_request(servo, action)
    if servo is not Servo.FRONT:
        raise click.BadParameter(f"{action!r} is not allowed: only servo front accepts degrees, servo {servo} does not")
    try:
        return servo_request(servo, deg=int(action))
    except ValueError as error:
        raise click.BadParameter(str(error)) from None


def _arm(ctx: click.Context, _: click.Parameter, words: tuple[str, ...]) -> tuple[tuple[str, ...], CommandRequest]:
    """Split the words into cars and six joints. Return the cars and the request."""
    cars, joints = words[:-6] or words[:1], words[-6:] if len(words) > 6 else words[1:]
    if not words:
        raise click.UsageError(describe_usage(ctx), ctx)
    needed = f"6 are needed, 0 to 180 degrees each, as: {_ARM_EXAMPLE}"
    if len(cars) > 1 and any(each.isdigit() for each in cars):  # a number among the cars is more likely a seventh joint
        cars, joints = words[:1], words[1:]
    for number, joint in enumerate(joints, start=1):
        if not re.fullmatch("[0-9]{1,3}", joint) or int(joint) > 180:
            raise click.BadParameter(f'joint {number} is "{joint}": {needed}')
    if len(joints) != 6:
        raise click.BadParameter(f"{len(joints)} joints given: {needed}")
    return _names(ctx, cars), arm_request([int(joint) for joint in joints])


def _fan(ctx: click.Context, _: click.Parameter, words: tuple[str, ...]) -> tuple[tuple[str, ...], CommandRequest]:
    """Split the words into cars and the state, if there is one. Return the cars and the request."""
    state = words[-1] if len(words) > 1 and words[-1] in tuple(FanState) else None
    cars = words[:-1] if state else words
    if not cars:
        raise click.UsageError(describe_usage(ctx), ctx)
    return _names(ctx, cars), fan_request(state)


def _names(ctx: click.Context, words: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(name for word in words for name in CarNames().convert(word, None, ctx))


@click.command(epilog="\b\nexamples:\n  fleet led red '#ff0010'\n  fleet led red blue green")
@cars_argument
@click.argument("color", type=Color())
@json_option
@with_client
def led(client: Fleet, cars: tuple[str, ...], color: tuple[int, int, int], *, as_json: bool) -> None:
    """Set the color LED to any color. The light is a different lamp, with seven colors: see `fleet light`."""
    carry_out(client, led_request(*color), cars, as_json=as_json)


@click.command(epilog="\b\nexamples:\n  fleet light red,blue cyan\n  fleet light all off\n  fleet light red '#ff8000'")
@cars_argument
@click.argument("request", type=_LightColor(), metavar="COLOR")
@json_option
@with_client
def light(client: Fleet, cars: tuple[str, ...], request: CommandRequest, *, as_json: bool) -> None:
    """Set the light of a car to a color or off. With any other color (#rrggbb), this sets its LED instead."""
    carry_out(client, request, cars, as_json=as_json)


@click.command(
    epilog="\b\nexamples:\n  fleet servo red front 90\n  fleet servo blue vertical up",
    context_settings=_NEGATIVE_NUMBERS,
)
@cars_argument
@click.argument("servo", type=Choice("servo", Servo))
@click.argument("request", metavar="ACTION", callback=_servo)
@take_option
@json_option
@with_client
def servo(
    client: Fleet,
    cars: tuple[str, ...],
    servo: str,  # noqa: ARG001 - it is in the request already
    request: CommandRequest,
    *,
    take: bool,
    as_json: bool,
) -> None:
    """Move a servo: left, right or reset (vertical: up, down or reset). The front servo also accepts 0 to 180 degrees.

    SERVO is front, horizontal or vertical. An arduino, stm32 or raspberry_pi car turns the front servo to 180 minus the
    number, and with the platform option +ptz_direct to the number.
    """
    carry_out(client, request, cars, take=take, as_json=as_json)


@click.command(epilog=f"\b\nexample:\n  {_ARM_EXAMPLE}", context_settings=_NEGATIVE_NUMBERS)
@click.argument("cars_and_request", nargs=-1, metavar="CAR... J1 J2 J3 J4 J5 J6", callback=_arm)
@take_option
@json_option
@with_client
def arm(client: Fleet, cars_and_request: tuple[tuple[str, ...], CommandRequest], *, take: bool, as_json: bool) -> None:
    """Move the six joints of the arm, 0 to 180 degrees each."""
    cars, request = cars_and_request
    carry_out(client, request, cars, take=take, as_json=as_json)


@click.command(epilog="\b\nexample:\n  fleet speed red up")
@cars_argument
@click.argument("step", type=Choice("speed step", SpeedStep))
@take_option
@json_option
@with_client
def speed(client: Fleet, cars: tuple[str, ...], step: str, *, take: bool, as_json: bool) -> None:
    """Go faster or slower by one step, up or down. Cars have no absolute speed."""
    carry_out(client, speed_request(step), cars, take=take, as_json=as_json)


@click.command(epilog="\b\nexamples:\n  fleet fan red\n  fleet fan red off")
@click.argument("cars_and_request", nargs=-1, metavar="CAR... [on|off]", callback=_fan)
@take_option
@json_option
@with_client
def fan(client: Fleet, cars_and_request: tuple[tuple[str, ...], CommandRequest], *, take: bool, as_json: bool) -> None:
    """Switch the fan. Cars can only toggle it, so `on` and `off` work only if its state is known."""
    cars, request = cars_and_request
    if cars[1:] and (near := misspelled(cars[-1], FanState)) and cars[-1] not in client.cars():
        raise click.UsageError(f'"{cars[-1]}" is neither a connected car nor on or off. Did you mean {near[0]}?')
    carry_out(client, request, cars, take=take, as_json=as_json)


def _plain_command(row: CommandType) -> click.Command:
    """Return the subcommand of a verb. Its row in `schemas.commands` says everything that is needed."""

    @cars_argument
    @json_option
    @with_client
    def command(client: Fleet, cars: tuple[str, ...], *, as_json: bool, **fields: float) -> None:
        carry_out(client, plain_request(row.verb, **fields), cars, as_json=as_json)

    example = f"fleet {row.subcommand} red"
    if row.max_duration_s:
        example += " --for 2s"
        limit = Duration(row.max_duration_s, row.min_duration_s)
        command = click.option("--for", "duration_s", type=limit, required=True, help="How long, such as 2s.")(command)
    return click.command(row.subcommand, help=row.summary, epilog=f"\b\nexample:\n  {example}")(command)


def __getattr__(name: str) -> click.Command:
    """Return the subcommand of this name if it has no function here."""
    for row in COMMANDS.values():
        if row.subcommand == name:
            return _plain_command(row)
    raise AttributeError(name)
