"""With FLEET_LOG=json one id follows a command through all processes: command line, console, coordinator, gateway."""

import json
import urllib.request
from pathlib import Path
from typing import Any

from schemas.commands import Verb
from schemas.process.json_log import LOG_VARIABLE
from tests.support.authority import PLAN
from tests.support.console import ConsoleProcess
from tests.support.processes import FleetProcesses, GatewayProcess, wait_for


def lines(process: GatewayProcess) -> list[dict[str, Any]]:
    """Return the log lines of a process. Each must be JSON; the last one may lack its end."""
    found = [json.loads(line) for line in process.stderr.splitlines(keepends=True) if line.endswith("\n")]
    for each in found:
        assert {"time", "level", "process", "pid", "message"} <= set(each), each
    return found


def of(process: GatewayProcess, verb: str) -> list[dict[str, Any]]:
    return [line for line in lines(process) if line.get("verb") == verb]


def test_one_id_follows_a_command_through_all_processes(fleet: FleetProcesses, tmp_path: Path) -> None:
    fleet.environment[LOG_VARIABLE] = "json"
    plan = tmp_path / "plan.yaml"
    plan.write_text(PLAN, encoding="utf-8")
    _, (link,) = fleet.simulate("red:arduino:tcp")
    gateway = fleet.gateway(link)
    fleet.ready()
    senders: dict[str, tuple[GatewayProcess, Verb]] = {}

    coordinator = fleet.start("-m", "fleet.cli", "plan", "run", str(plan))
    senders["fleet plan"] = coordinator, Verb.MODE
    wait_for(lambda: of(coordinator, Verb.MODE), "the coordinator sends its mode")
    console = ConsoleProcess(fleet)
    senders["fleet console"] = console.process, Verb.STOP
    stop = urllib.request.Request(f"{console.address}/stop", method="POST", headers={"Origin": console.address})
    with urllib.request.urlopen(stop) as answer:
        assert answer.status // 100 == 2
    wait_for(lambda: any(line["phase"] == "complete" for line in of(console.process, Verb.STOP)), "it stops")
    typed = fleet.start("-m", "fleet.cli", "estop", "red", "--why", 'a "chair"\x1b[31m')
    senders["fleet estop"] = typed, Verb.ESTOP
    assert typed.wait() == 0

    for name, (process, verb) in senders.items():
        sent, *_ = of(process, verb)
        assert (sent["process"], sent["pid"], sent["phase"]) == (name, process.pid, "asked"), name
        there = [line for line in of(gateway, verb) if line["command_id"] == sent["command_id"]]
        assert there, name
        assert {(line["process"], line["car"], line["pid"]) for line in there} == {("gateway", "red", gateway.pid)}
        assert (there[0]["phase"], there[0]["sender"]) == ("asked", sent["sender"])
        ended = [line for line in of(process, verb) if line["phase"] != "asked" and line["car"] == "red"]
        assert ended[0]["command_id"] == sent["command_id"]
        wait_for(
            lambda ended=ended, sent=sent, verb=verb: (
                ended[0]["phase"]
                in [line["phase"] for line in of(gateway, verb) if line["command_id"] == sent["command_id"]]
            ),
            "both know how it ended",
        )
    assert [line["code"] for line in lines(gateway) if line.get("code") == "estop"] == ["estop"]
