"""`fleet led, light, servo, arm, whistle, speed, fan, identify`: actions of a car without a duration."""

import re
from typing import Any, Final

import click

from fleet.client.client import Fleet
from fleet.client.commands import (
    CommandRequest,
    arm_request,
    fan_request,
    find_request,
    led_request,
    light_request,
    servo_request,
    speed_request,
    whistle_request,
)
from fleet.commands.options import carry_out, cars_argument, json_option, take_option, with_client
from gateway.protocol.enums import Light, SpeedStep

_NEGATIVE_NUMBERS: Final = {"ignore_unknown_options": True}
"""Context settings with which -1 is a wrong value and not an unknown option."""
_ARM_EXAMPLE: Final = "fleet arm red 90 90 45 120 90 30"


class _Color(click.ParamType[tuple[int, int, int]]):
    """Red, green and blue as `#rrggbb`."""

    name = "'#RRGGBB'"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int, int]:
        """Return three numbers, 0..255."""
        match = re.fullmatch(r"#?([0-9a-fA-F]{2})([0-9a-fA-F]{2})([0-9a-fA-F]{2})", str(value))
        if match is None:
            self.fail(
                f"{value!r} is not allowed: six hexadecimal digits, two each for red, green and blue, as '#ff0010'",
                param,
                ctx,
            )
        return int(match[1], 16), int(match[2], 16), int(match[3], 16)

    def get_missing_message(self, param: click.Parameter, ctx: click.Context | None) -> str:  # noqa: ARG002 - click's
        """Return a hint for users who forgot the quotes."""
        return "Six hexadecimal digits, in quotes: to a shell, what follows a bare # is a comment"


def _servo(ctx: click.Context, _: click.Parameter, action: str | None) -> CommandRequest:
    """Return the request for an action of the servo. Reject a wrong action before any query."""
    servo = ctx.params["servo"]
    if action is None or not re.fullmatch("[0-9]+", action):
        allowed = ("up", "down", "reset") if servo == "vertical" else ("left", "right", "reset")
        words = f"servo {servo}: {', '.join(allowed)}{' or 0 to 180 degrees' if servo == 'front' else ''}"
        if action is None:
            raise click.BadParameter(f"name what to do with {words}, as: fleet servo red {servo} {allowed[0]}")
        if action not in allowed:
            raise click.BadParameter(f"{action!r} is not allowed for {words}")
        return servo_request(servo, action)
    if servo != "front":
        raise click.BadParameter(f"{action!r} is not allowed: servo {servo} takes no degrees, only front does")
    try:
        return servo_request(servo, deg=int(action))
    except ValueError as error:
        raise click.BadParameter(str(error)) from None


def _arm(_: click.Context, __: click.Parameter, joints: tuple[str, ...]) -> CommandRequest:
    """Return the request for six joints."""
    needed = f"6 are needed, 0 to 180 degrees each, as: {_ARM_EXAMPLE}"
    for number, joint in enumerate(joints, start=1):
        if not re.fullmatch("[0-9]{1,3}", joint) or int(joint) > 180:
            raise click.BadParameter(f"joint {number}, {joint!r}, is not allowed: {needed}")
    if len(joints) != 6:
        raise click.BadParameter(f"{len(joints)} joints given: {needed}")
    return arm_request([int(joint) for joint in joints])


@click.command(epilog="\b\nexample:\n  fleet led red '#ff0010'")
@cars_argument
@click.argument("colour", type=_Color())
@json_option
@with_client
def led(client: Fleet, cars: tuple[str, ...], colour: tuple[int, int, int], *, as_json: bool) -> None:
    """Set the color LED."""
    carry_out(client, led_request(*colour), cars, as_json=as_json)


@click.command(epilog="\b\nexample:\n  fleet light red,blue cyan")
@cars_argument
@click.argument("light", type=click.Choice([str(light) for light in Light]))
@json_option
@with_client
def light(client: Fleet, cars: tuple[str, ...], light: str, *, as_json: bool) -> None:
    """Set the light."""
    carry_out(client, light_request(light), cars, as_json=as_json)


@click.command(
    epilog="\b\nexamples:\n  fleet servo red front 90\n  fleet servo blue vertical up",
    context_settings=_NEGATIVE_NUMBERS,
)
@cars_argument
@click.argument("servo", type=click.Choice(["front", "vertical", "horizontal"]))
@click.argument("request", metavar="left|right|up|down|reset|DEG", callback=_servo, required=False)
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
    """Move a servo: left, right or reset (vertical: up, down or reset); the front one also to 0..180 degrees.

    The number is sent unchanged; the front servo goes to 180 minus it.
    """
    carry_out(client, request, cars, take=take, as_json=as_json)


@click.command(epilog=f"\b\nexample:\n  {_ARM_EXAMPLE}", context_settings=_NEGATIVE_NUMBERS)
@cars_argument
@click.argument("request", nargs=-1, metavar="J1 J2 J3 J4 J5 J6", callback=_arm)
@take_option
@json_option
@with_client
def arm(client: Fleet, cars: tuple[str, ...], request: CommandRequest, *, take: bool, as_json: bool) -> None:
    """Move the arm's six joints to 0..180 degrees each."""
    carry_out(client, request, cars, take=take, as_json=as_json)


@click.command(epilog="\b\nexample:\n  fleet whistle red")
@cars_argument
@json_option
@with_client
def whistle(client: Fleet, cars: tuple[str, ...], *, as_json: bool) -> None:
    """Sound once."""
    carry_out(client, whistle_request(), cars, as_json=as_json)


@click.command(epilog="\b\nexample:\n  fleet speed red up")
@cars_argument
@click.argument("step", type=click.Choice([str(step) for step in SpeedStep]))
@take_option
@json_option
@with_client
def speed(client: Fleet, cars: tuple[str, ...], step: str, *, take: bool, as_json: bool) -> None:
    """Change the speed by one step: cars have no absolute speed."""
    carry_out(client, speed_request(step), cars, take=take, as_json=as_json)


@click.command(epilog="\b\nexamples:\n  fleet fan red\n  fleet fan red off")
@cars_argument
@click.argument("state", type=click.Choice(["on", "off"]), required=False)
@take_option
@json_option
@with_client
def fan(client: Fleet, cars: tuple[str, ...], state: str | None, *, take: bool, as_json: bool) -> None:
    """Toggle the fan; `on` and `off` only while the gateway knows its state."""
    carry_out(client, fan_request(state), cars, take=take, as_json=as_json)


@click.command(epilog="\b\nexample:\n  fleet identify red")
@cars_argument
@json_option
@with_client
def identify(client: Fleet, cars: tuple[str, ...], *, as_json: bool) -> None:
    """Make cars blink and beep, without moving."""
    carry_out(client, find_request(), cars, as_json=as_json)
