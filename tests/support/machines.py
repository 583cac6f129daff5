"""Three machines on one: network namespaces with a link between each and the hub's. Needs Linux and root.

The links can be cut. Each machine has a state directory of its own, and joins the hub by the commands for people.
"""

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil

from fleet.hub.local_hub import SECURE_ENDPOINT
from tests.support import bad_link
from tests.support.processes import GatewayProcess, wait_for

HUB, PI, OPERATOR = "fleet-hub", "fleet-pi", "fleet-operator"
WIRE = "fleet-wire"
"""Where the links lose and delay."""
SUBNETS = {PI: "10.77.1", OPERATOR: "10.77.2"}
_EXEC = "import os, sys; os.execvp('ip', ['ip', 'netns', 'exec', *sys.argv[1:]])"


_WITHOUT_OFFLOADS = "import sys; from tests.support.bad_link import without_offloads; without_offloads(sys.argv[1])"


def _ip(*words: str) -> None:
    done = subprocess.run(["ip", *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, (words, done.stderr, "this soak needs root, and network namespaces")


class Machines:
    """The three machines. `close` ends their processes and removes them.

    loss: share of the frames that each link loses, each way. delay_s: time that each link takes, each way, s.
    """

    def __init__(self, directory: Path, loss: float = 0.0, delay_s: float = 0.0) -> None:
        self.directory = directory
        self._started: list[GatewayProcess] = []
        self._zenohd: list[str] = []
        """Command of the stock router in the place of our hub; empty for ours."""
        for name in (HUB, PI, OPERATOR, WIRE):
            subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)
            _ip("netns", "add", name)
            _ip("-n", name, "link", "set", "lo", "up")
        for number, (name, subnet) in enumerate(SUBNETS.items()):
            ends = [(HUB, f"fleet{number}a", f"{subnet}.1"), (name, f"fleet{number}b", f"{subnet}.2")]
            for place, device, address in ends:
                _ip("-n", WIRE, "link", "add", f"{device}w", "type", "veth", "peer", "name", device, "netns", place)
                _ip("-n", place, "addr", "add", f"{address}/24", "dev", device)
                for where, which in ((place, device), (WIRE, f"{device}w")):
                    _ip("-n", where, "link", "set", which, "up")
                off = self.start(place, "-c", _WITHOUT_OFFLOADS, device)
                assert off.wait() == 0, off.stderr
            wires = [f"{device}w" for _, device, _ in ends]
            self.start(WIRE, bad_link.__file__, *wires, str(loss), str(delay_s), str(number)).line()
        self._devices = dict(zip(SUBNETS, ("fleet0a", "fleet1a"), strict=True))

    def start(self, machine: str, *arguments: str, **environment: str) -> GatewayProcess:
        """Start Python with these arguments on a machine."""
        return self.start_program(machine, sys.executable, *arguments, **environment)

    def start_program(self, machine: str, *arguments: str, **environment: str) -> GatewayProcess:
        """Start any program with its arguments on a machine."""
        own = {"FLEET_STATE_DIR": str(self.directory / machine), "FLEET_ENDPOINT": "", **environment}
        log = self.directory / f"{len(self._started)}.log"
        self._started.append(GatewayProcess(["-c", _EXEC, machine, *arguments], log, own))
        return self._started[-1]

    def run(self, machine: str, *arguments: str, **environment: str) -> tuple[int, list[str], str]:
        """Run `fleet` on a machine to its end. Return the exit code, the lines, and stderr."""
        process = self.start(machine, "-m", "fleet.cli", *arguments, **environment)
        code = process.wait()
        return code, process.lines(), process.stderr

    def make_hub(self, *cars: str) -> GatewayProcess:
        """Make the hub's machine the hub, also for these cars, and start it."""
        options = [word for car in cars for word in ("--car", car)]
        code, _, words = self.run(HUB, "hub", "init", *options, FLEET_AS="ann")
        assert code == 0, words
        hub = self._start_hub(HUB)
        self._await_hub()
        return hub

    def _start_hub(self, machine: str) -> GatewayProcess:
        return self.start(machine, "-m", "schemas.bus.hub", "--endpoint", SECURE_ENDPOINT, "--idle-s", "600")

    def _await_hub(self) -> None:
        def is_up() -> bool:
            code, _, words = self.run(HUB, "list")
            return code == 0 or "No car" in words

        wait_for(is_up, "the hub is up")

    def join(self, machine: str, *invited: str, at: str = "") -> None:
        """Let a machine join, by the commands that people type. at: the hub of the site that it uses."""
        address = f"{SUBNETS[machine]}.1"
        arguments = ("-m", "fleet.cli", "hub", "invite", *invited, "--json", "--as-hub", address)
        invitation = self.start(HUB, *arguments)
        said: Any = invitation.line()
        site = ("--at", at) if at else ()
        code, _, words = self.run(machine, "join", said["host"], said["code"], *site)
        assert code == 0, words
        assert invitation.wait() == 0, invitation.stderr

    def make_site(self, machine: str) -> GatewayProcess:
        """Make a machine the hub of another site, and start it."""
        self.join(machine, "--site", "north")
        return self._start_hub(machine)

    def record(self, machine: str, site: str = "") -> tuple[GatewayProcess, Path]:
        """Start a recorder. Return it and the directory of its sessions. site: the site whose hub this machine is."""
        place = self.directory / f"sessions-{machine}"
        options = ("--site", site) if site else ()
        recorder = self.start(machine, "-m", "fleet.cli", "record", "run", "--sessions", str(place), "--json", *options)
        recorder.line()
        return recorder, place

    def check_whole(self, *places: Path) -> None:
        """Require that each place has one whole session, and that these sessions merge into a whole one."""
        sessions = [str(session) for place in places for session in place.iterdir() if session.is_dir()]
        assert len(sessions) == len(places), sessions
        merged = self.directory / "merged"
        code, lines, words = self.run(HUB, "sessions", "merge", *sessions, "--out", str(merged))
        assert code == 0, (lines, words)
        for session in (*sessions, str(merged)):
            code, lines, words = self.run(HUB, "sessions", "verify", session, "--json")
            print(session, *lines, words)
            assert code == 0, (session, lines, words)

    def replace_hub(self, zenohd: Path) -> None:
        """Put a stock router in the place of our hub, with the same certificates and rules."""
        code, lines, words = self.run(HUB, "hub", "config")
        assert code == 0, words
        config = self.directory / "zenohd.json5"
        config.write_text("\n".join(lines))
        self._zenohd = [str(zenohd), "--config", str(config)]
        self._kill(*self._hubs())
        self.start_program(HUB, *self._zenohd)
        self._await_hub()

    def kill_hub(self) -> None:
        """Kill the hub, whoever has started it. A stock router is started again, as its service manager does."""
        hubs = self._hubs()
        assert hubs, "there is a hub"
        self._kill(*hubs)
        if self._zenohd:
            self.start_program(HUB, *self._zenohd)

    def _hubs(self) -> list[int]:
        listed = subprocess.run(["ip", "netns", "pids", HUB], capture_output=True, text=True, check=True).stdout.split()
        words = {int(pid): psutil.Process(int(pid)).cmdline() for pid in listed}
        return [pid for pid, each in words.items() if "schemas.bus.hub" in each or each[:1] == self._zenohd[:1] != []]

    @staticmethod
    def _kill(*pids: int) -> None:
        for pid in pids:
            os.kill(pid, signal.SIGKILL)

    def cut(self, machine: str) -> None:
        """Cut the link of a machine: no byte and no sign of its end goes through."""
        _ip("-n", HUB, "link", "set", self._devices[machine], "down")

    def mend(self, machine: str) -> None:
        """Mend the link of a machine."""
        _ip("-n", HUB, "link", "set", self._devices[machine], "up")

    def close(self) -> None:
        """End all processes, and remove the machines."""
        for process in self._started:
            if process.popen.poll() is None:
                process.popen.kill()
            process.wait()
        for name in (HUB, PI, OPERATOR, WIRE):
            listed = subprocess.run(["ip", "netns", "pids", name], capture_output=True, text=True, check=False)
            for pid in listed.stdout.split():
                subprocess.run(["kill", "-9", pid], check=False)
            subprocess.run(["ip", "netns", "del", name], check=False)


@contextlib.contextmanager
def machines(directory: Path, loss: float = 0.0, delay_s: float = 0.0) -> Iterator[Machines]:
    """Yield three machines, and remove them afterwards."""
    made = Machines(directory, loss, delay_s)
    try:
        yield made
    finally:
        made.close()
