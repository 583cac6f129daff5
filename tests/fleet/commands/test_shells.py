"""Completion by Tab in real shells, set up by the lines of docs/install.md."""

import os
import re
import shutil
import sys
from pathlib import Path

import pytest
import zenoh

from fleet.client.client import Fleet
from schemas import keys
from schemas.bus import reply_message, router_config
from schemas.gen import fleet_v1_pb2 as pb
from tests.support.ports import free_endpoint
from tests.support.processes import wait_for
from tests.support.soaks import only_in_soak
from tests.support.terminal import Terminal

SHELLS = {
    "bash": ("bash --norc --noprofile -i", 'eval "$(_FLEET_COMPLETE=bash_source fleet)"'),
    "zsh": ("zsh -f", 'autoload -Uz compinit; compinit -u; eval "$(_FLEET_COMPLETE=zsh_source fleet)"'),
    "fish": ("fish --no-config -i", "_FLEET_COMPLETE=fish_source fleet | source"),
}
"""The command that starts each shell without the user's files, and the line that sets completion up."""
TYPED = "fleet dri\tred,bl\t@l\tforw\t"
WHOLE = "fleet drive red,blue @lab forward"
BEGIN_OF_LINE = "\x01"
GROUPS_KEY = "fleet/@supervisor/status"


@pytest.mark.parametrize("shell", ["bash", *only_in_soak(("zsh", "fish"))])
def test_tab_completes_commands_cars_groups_and_motions(shell: str, tmp_path: Path) -> None:
    """The groups come from the running fleet, because there is no fleet file here."""
    if shutil.which(shell) is None:
        pytest.skip(f"needs {shell}")

    def answer(query: zenoh.Query) -> bool:
        reply_message(query, GROUPS_KEY, pb.Supervision(groups={"lab": "red,blue"}), as_json=False)
        return True

    words, setup = SHELLS[shell]
    assert setup.rpartition("; ")[2] in (Path(__file__).parents[3] / "docs/install.md").read_text(encoding="utf-8")
    endpoint = free_endpoint()
    programs = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    environment = {"PATH": programs, "FLEET_ENDPOINT": endpoint, "HOME": str(tmp_path), "COLUMNS": "80"}
    with zenoh.open(router_config(endpoint)), Fleet(endpoint, kind="person") as fleet:
        tokens = [fleet.bus.token(keys.car_token("fleet", car)) for car in ("red", "green", "blue")]
        fleet.bus.queryable(GROUPS_KEY, answer)
        program = ("setsid", "--ctty", "--wait", *words.split())
        terminal = Terminal(program=program, environment=environment, directory=tmp_path)
        try:
            terminal.type(f"{setup}; echo set-$(echo up)" if shell != "fish" else f"{setup}; echo set-(echo up)")
            terminal.until("set-up")
            tries = iter(range(100))

            def completed() -> bool:
                """Type the line again. If no names come within 0.3 s on a busy machine, a person presses Tab again."""
                number = next(tries)
                terminal.type(f"{TYPED}{BEGIN_OF_LINE}echo {number}-")
                found = re.compile(rf"^{number}-(fleet.*?) *$", re.MULTILINE)
                wait_for(lambda: found.search(terminal.shown.replace("\r", "\n")), "the shell prints the line")
                (line,) = found.findall(terminal.shown.replace("\r", "\n"))[-1:]
                return bool(line == WHOLE)

            wait_for(completed, f"{WHOLE}: {terminal.shown[-2000:]}")
            terminal.type("exit")
            assert len(tokens) == 3
        finally:
            terminal.close()
