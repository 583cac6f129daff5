"""`fleet record start, stop, status` and `fleet mark`: asking the recorder that runs, over the bus."""

import json
from typing import Any

import click
from google.protobuf.json_format import MessageToDict

from fleet.client.client import default_sender
from fleet.commands.options import bus_options, json_option
from fleet.recording.writing.recorder import MAX_MARK_CHARACTERS
from schemas import keys, messages
from schemas.bus import Bus, Failure

_TIMEOUT_S = 15.0
"""A session that is closed waits for the disk."""


def _ask(verb: str, connect: str | None, fleet: str, **fields: str) -> Any:
    """What the recorder says of itself then; raises click's errors."""
    keys.check_name(fleet, "fleet name")
    with Bus.open(connect) as bus:
        key = keys.command_key(fleet, keys.RECORDER, verb)
        payload = json.dumps(fields).encode()
        for answer in bus.query(key, payload=payload, encoding=messages.JSON, timeout_s=_TIMEOUT_S):
            if isinstance(answer, Failure):
                raise click.ClickException(f"the recorder says: {answer.words}")
            return answer.message()
        raise click.ClickException(
            f"no recorder of fleet {fleet!r} is on the bus at {bus.endpoint}: `fleet record` starts one"
        )


def _show(found: Any, *, as_json: bool) -> None:
    if as_json:
        click.echo(json.dumps(MessageToDict(found, preserving_proto_field_name=True)))
        return
    click.echo(
        f"{found.state}: {found.session}, {found.messages} messages, {found.bytes / 1e6:.1f} MB in "
        f"{found.segments} file{'s' * (found.segments != 1)}, {found.free_bytes / 1e9:.1f} GB free"
    )
    for counts, words in ((found.drops, "dropped for want of room"), (found.missed, "missed on the bus")):
        if counts:
            worst = max(counts, key=lambda key: counts[key])
            click.echo(f"{sum(counts.values())} {words}, most of {worst}: {counts[worst]}")
    if found.recovered:
        click.echo(f"{sum(found.recovered.values())} were missed at first and had again from their publishers")
    for words in (found.error, found.warning):
        if words:
            click.echo(words)


@click.command()
@json_option
@bus_options
def start(connect: str | None, fleet: str, *, as_json: bool) -> None:
    """Let the recorder begin a new session, after `stop`."""
    _show(_ask("start", connect, fleet), as_json=as_json)


@click.command()
@json_option
@bus_options
def stop(connect: str | None, fleet: str, *, as_json: bool) -> None:
    """Close the session; the recorder stays, for `start`."""
    _show(_ask("stop", connect, fleet), as_json=as_json)


@click.command()
@json_option
@bus_options
def status(connect: str | None, fleet: str, *, as_json: bool) -> None:
    """What is being recorded, where to, how much was lost, and whether there is room."""
    _show(_ask("status", connect, fleet), as_json=as_json)


@click.command(epilog="\b\nexample:\n  fleet mark 'the blue one lost the line'")
@click.argument("text")
@click.option("--by", metavar="NAME", help="Who says it (default: you, as others are told).")
@bus_options
def mark(text: str, by: str | None, connect: str | None, fleet: str) -> None:
    """Write TEXT into the recording, at this moment; a marked session is spared by the quota."""
    if not text.strip() or len(text) > MAX_MARK_CHARACTERS:
        raise click.UsageError(f"TEXT must have 1 to {MAX_MARK_CHARACTERS} characters, and not only blanks")
    found = _ask("mark", connect, fleet, text=text, by=by or default_sender())
    click.echo(f"marked in {found.session}")
