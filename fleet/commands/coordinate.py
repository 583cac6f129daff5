"""`fleet coordinate`: the coordinator as a process. What it does is coordinator.py's."""

import json
import os
import signal
import threading
from pathlib import Path
from types import FrameType

import click

from fleet.client import Fleet, default_sender
from fleet.commands.common import bus_options, json_option
from fleet.coordinator import SENDER, AnotherCoordinator, Coordinator
from fleet.policy.decide import Decision
from fleet.policy.plan import Plan, parse


@click.command(
    epilog="""\b
example:
  fleet coordinate --plan deploy/plan.yaml

\b
a plan:
  cars:
    red: tracking
    blue: manual
  rules:
    - when: {car: red, reading: sensor/range, field: range_m, below: 0.3, for_s: 0.5}
      then: {car: blue, mode: obstacle_avoidance}"""
)
@click.option("--plan", "path", required=True, type=click.Path(path_type=Path, dir_okay=False), help="The plan, YAML.")
@click.option("--with-parent", is_flag=True, help="End when the process that started this ends.")
@json_option
@bus_options
def coordinate(path: Path, connect: str | None, fleet: str, *, with_parent: bool, as_json: bool) -> None:
    """Keep the cars of a plan in their modes, until Ctrl-C; cars on hold are left alone. One line per decision."""
    parent = os.getppid() if with_parent else None
    plan = _read(path)
    stop = threading.Event()

    def ask_to_stop(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    signal.signal(signal.SIGINT, ask_to_stop)
    signal.signal(signal.SIGTERM, ask_to_stop)

    def decided(decision: Decision) -> None:
        click.echo(_json(decision) if as_json else _line(decision))

    with Fleet(connect, fleet, sender=f"{SENDER}{default_sender()}", kind="coordinator", start_hub=True) as client:
        try:
            Coordinator(client, plan, decided, lambda words: click.echo(f"fleet: {words}", err=True)).run(
                lambda: stop.is_set() or parent not in (None, os.getppid())
            )
        except AnotherCoordinator as error:
            raise click.ClickException(str(error)) from None


def _read(path: Path) -> Plan:
    try:
        return parse(path.read_text(encoding="utf-8"), str(path))
    except UnicodeDecodeError:
        raise click.UsageError(f"{path} is not a text in UTF-8: a plan is YAML") from None
    except OSError as error:
        raise click.UsageError(f"the plan {path} cannot be read: {error.strerror}") from None


def _line(decision: Decision) -> str:
    readings = f" ({', '.join(decision.readings)})" if decision.readings else ""
    wanted = decision.mode or "left alone"
    return f"{decision.car}: {wanted}, because of {decision.why}{readings}; would change with: {decision.would_change}"


def _json(decision: Decision) -> str:
    return json.dumps(
        {
            "car": decision.car,
            "mode": decision.mode,
            "why": decision.why,
            "readings": decision.readings,
            "would_change": decision.would_change,
        }
    )
