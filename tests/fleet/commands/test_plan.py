"""`fleet why` and `fleet plan` without a plan."""

from pathlib import Path

import zenoh
from click.testing import CliRunner, Result

from fleet.cli import cli
from fleet.client.client import Fleet
from fleet.client.hints import complete_hints
from schemas import keys
from schemas.bus import reply_message, router_config
from schemas.gen import fleet_v1_pb2 as pb
from schemas.local_time import clock
from tests.support.ports import free_endpoint


def test_without_a_plan_each_command_names_what_works(tmp_path: Path) -> None:
    plan, endpoint = tmp_path / "plan.yaml", free_endpoint()
    plan.write_text("roles: {line: {mode: tracking}}\n", encoding="utf-8")
    safety = pb.Safety(car="red", hold=pb.Hold(by="ann@lab-1", rank="lead"))

    def run(*words: str) -> Result:
        return CliRunner().invoke(cli, [*words, "--connect", endpoint])

    options = f"--connect {endpoint}"
    with zenoh.open(router_config(endpoint)), Fleet(endpoint, kind="person") as client:

        def answer(query: zenoh.Query) -> bool:
            reply_message(query, "fleet/red/state/safety", safety, as_json=False)
            return True

        client.bus.queryable("fleet/red/state/safety", answer)
        commands = (("plan", "set", str(plan)), ("plan", "show"), ("plan", "stop"), ("why", "blue"))
        for words in commands:
            done = run(*words)
            assert done.exit_code == 1
            assert done.stderr == complete_hints(
                "Error: No plan is running. Start one: `fleet plan run FILE`, "
                "or a fleet with one: `fleet up --plan FILE`.\n",
                options,
            )
        token = client.bus.token(keys.car_token("fleet", keys.SUPERVISOR))
        for words in commands:
            one = complete_hints("Error: No plan is running. Start one: `fleet plan run FILE`.\n", options)
            assert run(*words).stderr == one, token
        held = "red: on hold by ann (lead); `fleet resume red` ends it. No plan is running.\n"
        assert run("why", "red").stdout == complete_hints(held, options)
        safety.estops.add(id="1", by="bob", why="fire")
        estopped = "red: e-stopped by bob: fire; `fleet resume red --estops` ends it; on "
        assert run("why", "red").stdout.startswith(complete_hints(estopped, options))
        stopped = pb.Safety()
        stopped.CopyFrom(safety)
        safety.CopyFrom(pb.Safety(car="red", motors="off", motors_basis="shown"))
        free = run("why", "red")
        assert (free.exit_code, free.stderr) == (0, "")
        assert (
            free.stdout == "red: nobody has stopped, borrowed or drives it; motors off (shown). No plan is running.\n"
        )
        safety.CopyFrom(stopped)
        safety.loan.CopyFrom(pb.Loan(to="eve", by="ann@lab-1", rank="lead", expires_in_s=60))
        safety.loan.since.seconds = at = 1_790_000_000
        safety.pauses.add(by="ann@lab-1", rank="lead", why="listen").stamp.seconds = at
        since = f"by ann (lead) since {clock(at)}"
        shown = run("why").stdout
        for held in (
            f"paused with the whole fleet {since}: listen; `fleet unpause` ends it; ",
            f"lent to eve {since}, for another 60 s; `fleet lend red --end` ends it. No plan",
        ):
            assert complete_hints(held, options) in shown
        safety.CopyFrom(pb.Safety(car="red"))
        assert run("why").stderr == one


def test_why_tells_that_a_new_coordinator_has_not_decided_yet() -> None:
    endpoint = free_endpoint()
    with zenoh.open(router_config(endpoint)), Fleet(endpoint, kind="person") as client:
        token = client.bus.token(keys.car_token("fleet", keys.COORDINATOR))

        def answer(query: zenoh.Query) -> bool:
            reply_message(query, "fleet/@coordinator/plan", pb.Plan(text="roles: {}"), as_json=False)
            return True

        client.bus.queryable("fleet/@coordinator/plan", answer)
        done = CliRunner().invoke(cli, ["why", "--connect", endpoint])
        assert (done.exit_code, done.stdout) == (0, ""), token
        assert done.stderr


def test_coordinator_that_does_not_answer_is_not_called_absent(tmp_path: Path) -> None:
    """Such as one that hangs: its token ends after 2 s. "No plan is running" was said, and "Start one"."""
    plan, endpoint = tmp_path / "plan.yaml", free_endpoint()
    plan.write_text("roles: {line: {mode: tracking}}\n", encoding="utf-8")
    status = pb.Supervision(state="running", processes=[pb.Supervised(name="@coordinator", kind="coordinator")])
    status.processes[0].state = "running"
    safety = pb.Safety(car="red", motors="off", motors_basis="shown")

    def run(*words: str) -> Result:
        return CliRunner().invoke(cli, [*words, "--connect", endpoint])

    with zenoh.open(router_config(endpoint)), Fleet(endpoint, kind="person") as client:

        def answer(query: zenoh.Query) -> bool:
            key = str(query.key_expr)
            reply_message(query, key, status if key.endswith("/status") else safety, as_json=False)
            return True

        token = client.bus.token(keys.car_token("fleet", keys.COORDINATOR))
        for words in (["why", "red"], ["plan", "show"]):
            assert "is on the bus and does not answer" in run(*words).stderr, words
        token.undeclare()
        client.bus.queryable("fleet/@supervisor/status", answer)
        client.bus.queryable("fleet/red/state/safety", answer)
        for words in (["plan", "set", str(plan)], ["plan", "show"], ["plan", "stop"], ["why"], ["why", "red"]):
            done = run(*words)
            assert (done.exit_code, "does not answer: its process is running. " in done.stderr) == (1, True), words
            assert "No plan" not in done.output
        assert run("why", "red").stdout == "red: nobody has stopped, borrowed or drives it; motors off (shown).\n"
        status.processes[0].state, status.processes[0].words = "waiting", "was ended by signal 9"
        assert "its process is waiting (was ended by signal 9). " in run("why", "red").stderr
        status.processes[0].state = "ended"
        assert run("why", "red").stdout.endswith(" No plan is running.\n")


def test_why_does_not_call_the_readings_of_a_decision_new() -> None:
    """A reading from which a decision followed a minute ago was printed as 0.4 s old."""
    endpoint = free_endpoint()
    decision = pb.Decision(subject="red", decided="tracking", why="role line (1 of 1)", would_change="a stop")
    decision.readings.append("red/sensor/battery voltage_v=7.4 (0.4 s old)")
    with zenoh.open(router_config(endpoint)), Fleet(endpoint, kind="person") as client:

        def answer(query: zenoh.Query) -> bool:
            reply_message(query, "fleet/@coordinator/decision", decision, as_json=False)
            return True

        client.bus.queryable("fleet/@coordinator/decision", answer)
        shown = CliRunner().invoke(cli, ["why", "red", "--connect", endpoint]).stdout.splitlines()
    assert "  reading then: red/sensor/battery voltage_v=7.4 (0.4 s old)" in shown
