"""`fleet plan try`: replays a session through a plan, and compares its decisions with the recorded ones."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from fleet.commands.exit_code import cli_errors
from fleet.commands.options import json_option
from fleet.commands.output import echo_safely
from fleet.commands.params import Duration, SessionPath, session_argument

if TYPE_CHECKING:
    from fleet.policy.plan.plan import Plan
    from fleet.policy.snapshot import CarSnapshot
    from fleet.recording.reading.session import Session
    from fleet.replay.analysis.decision_differences import DecisionDifference
    from fleet.replay.analysis.recorded_decisions import (
        CoordinatorRun,
        PresenceToken,
        RecordedDecision,
    )
    from fleet.replay.analysis.replan import Replanning

# Live, a car's token shows at once that the car has gone. A recording has only the car's states, which come once a
# second. So a replay notices this up to a second later.
TOLERANCE_S: Final = 2.0
"""Default time by which a decision may come earlier or later and still count as the same."""


@click.command(
    epilog="""\b
examples:
  fleet plan try new.yaml
  fleet plan try latest~1
  fleet plan try latest~1 new.yaml

Exit codes: 0 no differences, 1 differences or nothing to compare, 2 wrong use or a wrong plan."""
)
@session_argument
@click.argument("path", metavar="[PLAN]", required=False, type=click.Path(path_type=Path, dir_okay=False))
@click.option(
    "--fleet-file",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Read the cars' capabilities and roles in FILE (default: the copy in the session, if there is one).",
)
@click.option(
    "--tolerance",
    default=f"{TOLERANCE_S:g}s",
    show_default=True,
    type=Duration(60.0, 0.1),
    help="Time by which a decision may come earlier or later and still count as the same.",
)
@json_option
def try_plan(session: Path, path: Path | None, fleet_file: Path | None, tolerance: float, *, as_json: bool) -> None:
    """Replay the recorded sensor data through a plan and show where it would have decided differently.

    Without PLAN, the command uses the session's own plan. The cars' messages stay as recorded whatever the plan
    decides. The same is true for stops and drives by people.
    """
    from fleet.coordinator.observer import listed_cars
    from fleet.fleetfile.fleet_file import read_fleet
    from fleet.policy.plan.plan_parser import parse
    from fleet.recording.reading.session import NoSession, Session
    from fleet.recording.session_dir import FLEET_FILE
    from schemas.yaml_document.document import read_text

    if path is None and session.suffix in (".yaml", ".yml"):
        path, session = session, SessionPath().convert("latest", None, click.get_current_context())
    elif path is not None and session.suffix in (".yaml", ".yml") and path.suffix not in (".yaml", ".yml"):
        raise click.UsageError(f"Write the session first: fleet plan try {path} {session}")
    with cli_errors():
        plan = None if path is None else parse(read_text(path), str(path))
        try:
            found = Session(session)
            own = found.path / FLEET_FILE
            listed: Mapping[str, CarSnapshot] = {}
            if fleet_file is not None:
                listed = listed_cars(read_fleet(fleet_file, unbound=True))
            elif found.path.is_dir() and own.is_file():
                # The session has the plan as plan.yaml, even if the copied fleet file gives it another name.
                listed = listed_cars(read_fleet(own, unbound=True, moved=True))
            compared = _ReplanReport(found, plan, listed, round(tolerance * 1e9))
            compared.go()
        except NoSession as error:
            raise click.ClickException(str(error)) from None
    for each in compared.found:
        echo_safely(json.dumps(_fields(each, compared.origin_ns)) if as_json else _describe(each, compared.origin_ns))
    compared.report(as_json=as_json)
    raise SystemExit(1 if compared.found else 0)


class _ReplanReport:
    """One run of `fleet plan try`: replays every coordinator of a session and collects the differences."""

    def __init__(
        self, session: "Session", plan: "Plan | None", listed: "Mapping[str, CarSnapshot]", tolerance_ns: int
    ) -> None:
        self._session = session
        self._plan = plan
        self._listed = listed
        self._tolerance_ns = tolerance_ns
        self.found: list[DecisionDifference] = []
        self.origin_ns = 0
        self._runs: list[CoordinatorRun] = []
        self._decisions = 0
        self._late_ns: list[int] = []

    def go(self) -> None:
        """Compare the decisions. Raises BadPlan, and ClickException if there is nothing to compare."""
        from fleet.policy.state import PersistedPolicy
        from fleet.recording.tools.summary import of_session
        from fleet.replay.analysis import recorded_decisions
        from fleet.replay.analysis.replan import Replanning, plans_of
        from schemas.yaml_document.document import read_text

        about = of_session(self._session)
        self.origin_ns = about.start_ns
        self._runs = [
            run
            for run in recorded_decisions.runs(self._session.messages(recorded_decisions.DECISION_KEYS))
            if run.decisions
        ]
        if not self._runs:
            damage = f" ({self._session.damage_words})" if self._session.damage else ""
            raise click.ClickException(
                f"{self._session.path} has no decisions of a coordinator (FLEET/@coordinator/decision): "
                f"there is nothing to compare a plan with{damage}"
            )
        self._refuse_without_cars()
        tokens = recorded_decisions.presence(self._session.messages(recorded_decisions.STATE_KEYS), about.end_ns)
        persisted = PersistedPolicy()
        for run in self._runs:
            if not run.plans and (self._session.path / "plan.yaml").is_file():
                run.plans.append((run.start_ns, read_text(self._session.path / "plan.yaml")))
            recorded = plans_of(run) if self._plan is None else []
            plans = (
                [(at_ns, plan) for (at_ns, _), plan in zip(run.plans, recorded, strict=True)]
                if self._plan is None
                else [(run.start_ns, self._plan)]
            )
            if not plans:
                raise click.ClickException(f"{self._session.path} has no plan: give a plan file after the session")
            again = Replanning(run, plans, self._listed, persisted)
            persisted = self._compare_run(run, again, tokens)

    def _refuse_without_cars(self) -> None:
        """Reject a session that was cut to some cars: messages on which the decisions depend are missing."""
        from fleet.recording.tools.merge_cut_recover import origin_of

        left = origin_of(self._session).get("cars")
        if not left:
            return
        decided = {
            car for run in self._runs for car in (*run.roles, *(each for each in run.decisions if " " not in each))
        }
        if others := sorted(decided - {*left, "phase"}):
            raise click.ClickException(
                f"{self._session.path} was cut to {', '.join(left)}, but its decisions also depended on "
                f"{', '.join(others)}, whose messages are not in it; try the session from which it was cut"
            )

    def _compare_run(self, run: "CoordinatorRun", again: "Replanning", tokens: "list[PresenceToken]") -> Any:
        from fleet.replay.analysis.decision_differences import differences
        from fleet.replay.analysis.replan import COORDINATOR_HISTORY_NS, keys_for

        expressions = keys_for(run.fleet, (plan for _, plan in again.plans))
        messages = self._session.messages(expressions, run.start_ns - COORDINATOR_HISTORY_NS, run.end_ns + 1)
        persisted = again.go(messages, tokens)
        self._decisions += sum(map(len, run.decisions.values()))
        for each in differences(run.decisions, again.decisions, run.start_ns, run.end_ns):
            if not run.whole and (each.then is None or (each.now is None and self._plan is None)):
                continue  # it may be from before the recording began
            if each.to_ns - each.from_ns > self._tolerance_ns:
                self.found.append(each)
            else:
                self._late_ns.append(each.to_ns - each.from_ns)
        self.found.sort(key=lambda each: each.from_ns)
        return persisted

    def report(self, *, as_json: bool) -> None:
        """Print what was compared."""
        late_s = max(self._late_ns, default=0) / 1e9
        partly = sum(not run.whole for run in self._runs)
        spans = [[(run.start_ns - self.origin_ns) / 1e9, (run.end_ns - self.origin_ns) / 1e9] for run in self._runs]
        if as_json:
            summary: dict[str, Any] = {"differences": len(self.found), "decisions": self._decisions, "spans_s": spans}
            summary |= {"latest_s": late_s, "begun_before": partly, "damage": self._session.damage_words}
            click.echo(json.dumps(summary))
            return
        found = f"{len(self.found)} differences" if self.found else "no difference"
        times = ", ".join(f"{start:.1f} s to {end:.1f} s" for start, end in spans)
        echo_safely(f"{self._session.path}: {self._decisions} decisions from {times}: {found}")
        click.echo(f"equal decisions came at most {late_s:.2f} s apart", err=True)
        if partly:
            click.echo(
                "a coordinator started before the recording began: the recording lacks what it knew by then", err=True
            )
        if self._session.damage:
            echo_safely(f"only the intact part was used: {self._session.damage_words}", err=True)


def _describe(each: "DecisionDifference", origin_ns: int) -> str:
    start_s, length_s = (each.from_ns - origin_ns) / 1e9, (each.to_ns - each.from_ns) / 1e9
    lines = [f"{each.subject} at +{start_s:.1f}s for {length_s:.1f} s:"]
    for name, decision in (("then", each.then), ("now", each.now)):
        if decision is None:
            lines.append(f"  {name}: nothing was decided")
            continue
        lines.append(f"  {name}: {decision}, because: {decision.why}")
        lines += [f"        with {reading}" for reading in decision.readings]
        if decision.would_change:
            lines.append(f"        would change if {decision.would_change}")
    return "\n".join(lines)


def _fields(each: "DecisionDifference", origin_ns: int) -> dict[str, Any]:
    return {
        "subject": each.subject,
        "from_s": (each.from_ns - origin_ns) / 1e9,
        "to_s": (each.to_ns - origin_ns) / 1e9,
        "then": _fields_of(each.then),
        "now": _fields_of(each.now),
    }


def _fields_of(decision: "RecordedDecision | None") -> dict[str, Any] | None:
    if decision is None:
        return None
    return {
        "kind": decision.kind,
        "decided": decision.decided,
        "role": decision.role,
        "why": decision.why,
        "readings": list(decision.readings),
        "would_change": decision.would_change,
    }
