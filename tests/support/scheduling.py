"""Assigns tests to workers of pytest-xdist.

Tests that compute have workers of their own, in the background, with a low priority. The other tests have the
foreground: they mostly wait for processes, cars and seconds. The background is done first, because it gets all the time
that the foreground leaves. From then on, half of that time would be lost. So there are workers in reserve, which help
the foreground when the background is done.

A worker collects only the files whose tests it may run. When each of the thirteen collected all, both processors did
nothing else for the first half minute.
"""

import os
from collections import Counter
from collections.abc import Sequence
from enum import Enum, auto
from itertools import chain
from pathlib import Path
from typing import Final

import pytest
from xdist.remote import Producer
from xdist.scheduler.loadgroup import LoadGroupScheduling
from xdist.workermanage import WorkerController

FOREGROUND_PER_PROCESSOR: Final = 3.5
"""Workers per processor for tests of processes. With 4, a stop of a simulated car was not shown in time in one of four
runs."""
SUITES: Final = "SUITES_AT_ONCE"
"""Environment variable: number of suites that share this machine (`make stress`), each with its part of the workers."""
SUITE: Final = "SUITE_NUMBER"
"""Environment variable: index of this suite, from 0. Each suite has its part of the ports."""
RESERVE_PER_PROCESSOR: Final = 2.0
"""Workers in reserve per processor."""
_PROCESSORS: Final = max(1, (os.cpu_count() or 1) // int(os.environ.get(SUITES, "1")))
_FOREGROUND: Final = int(FOREGROUND_PER_PROCESSOR * _PROCESSORS)
_RESERVE: Final = int(RESERVE_PER_PROCESSOR * _PROCESSORS)
WORKERS: Final = _FOREGROUND + _RESERVE + _PROCESSORS
"""Number of workers. One for each processor is in the background."""
_WHOLE: Final = ("tests",)
"""The arguments of a run of all tests, which has workers of different kinds. In a run of few tests, each worker takes
all: beside workers of the foreground, those in the background would get no time."""
SESSION: Final = pytest.StashKey[pytest.Session]()
_KIND: Final = "kind"
"""The name of a worker's kind in its input."""
_LOWEST_PRIORITY: Final = 19
_COMPUTING_TIMEOUT_S: Final = 600
"""Timeout of a test that computes. In the background it waits for all other processes: on a machine with other work, a
test of 6 s took more than the 120 s of the other tests."""
_FEW: Final = 2
"""Number of tests with which a worker gets more, as in pytest-xdist: one runs, and it must know the next one."""
_ASSIGNED_TOGETHER: Final = 8
"""Number of short tests of a file that one worker gets with one message. With a message for each test, the messages and
the bookkeeping of pytest-xdist took as long as 4,000 of its shortest tests."""
_AUTOGROUP: Final = Path("/proc/self/autogroup")
"""The file that sets the priority of a session on Linux. With autogroups, Linux shares the processors equally among
sessions, and `nice` counts only within a session: beside two workers at the lowest priority, a gateway in a session of
its own got 70 % of a processor."""

_COMPUTING: Final = (
    "tests/deploy/",
    "tests/fleet/conditions/",
    "tests/fleet/fleetfile/",
    "tests/fleet/policy/",
    "tests/fleet/recording/reading/",
    "tests/fleet/recording/test_catalog",
    "tests/fleet/recording/tools/",
    "tests/fleet/replay/analysis/",
    "tests/fleet/replay/rerun/",
    "tests/fuzz/",
    "tests/gateway/control/",
    "tests/gateway/drivers/",
    "tests/gateway/sim/model/",
    "tests/gateway/sim/scenarios/",
    "tests/schemas/",
    "tests/test_",
)
"""Places of tests that compute on virtual time, or read files. All other tests wait for processes, cars and seconds."""
_LONG: Final = ("tests/fuzz/",)
"""Places of tests that take seconds. They are assigned one by one."""
_SLOW: Final = (
    "tests/fleet/test_demo.py",
    "tests/gateway/link/test_ble",
    "tests/gateway/test_slept.py",
    "tests/gateway/tools/test_scan.py",
)
"""Files with tests of 10 to 40 s. They would come last, and one worker would run them after the others are done."""
_STARTING: Final = (
    "tests/fleet/replay/analysis/test_replan.py",
    "tests/fleet/replay/rerun/test_live.py",
    "tests/schemas/test_bus.py",
)
"""Files in these places that start processes, or time Zenoh's threads. At low priority, a Rerun viewer took longer than
40 s to go on, and a session did not see the tokens of a new link in time."""


class WorkerKind(Enum):
    """Which tests a worker collects and runs."""

    ALL = auto()
    """All tests, as in a run without workers."""
    FOREGROUND = auto()
    """Tests that do not only compute."""
    RESERVE = auto()
    """Tests of the foreground, when the background is done."""
    BACKGROUND = auto()
    """Tests that only compute, with low priority."""


def computes(nodeid: str) -> bool:
    """Return True if a test only computes."""
    return nodeid.startswith(_COMPUTING) and not nodeid.startswith(_STARTING)


def sort(items: list[pytest.Item]) -> None:
    """Put tests that compute last, where workers in the background take them. Put large groups and slow files first.

    Give tests that compute more time, too.
    """
    groups = {item: _group(item) for item in items}
    sizes = Counter(filter(None, groups.values()))
    for item in items:
        if computes(item.nodeid) and item.get_closest_marker("timeout") is None:
            item.add_marker(pytest.mark.timeout(_COMPUTING_TIMEOUT_S))
    items.sort(key=lambda item: (computes(item.nodeid), -sizes[groups[item]], not item.nodeid.startswith(_SLOW)))


def _group(item: pytest.Item) -> str:
    """Return the group of a test, which runs on one worker. Empty if the test has none."""
    mark = item.get_closest_marker("xdist_group")
    return str((*mark.args, *mark.kwargs.values())[0]) if mark is not None else ""


def choose_kind(node: WorkerController) -> None:
    """Choose the kind of a worker, such as `gw7`, before it starts. One that replaces a crashed one takes all tests."""
    index = int(node.gateway.id.removeprefix("gw"))
    if node.workerinput["workercount"] != WORKERS or tuple(node.config.args) != _WHOLE or index >= WORKERS:
        kind = WorkerKind.ALL
    elif index < _FOREGROUND:
        kind = WorkerKind.FOREGROUND
    else:
        kind = WorkerKind.RESERVE if index < _FOREGROUND + _RESERVE else WorkerKind.BACKGROUND
    node.workerinput[_KIND] = kind.name


def kind_of(node: WorkerController | pytest.Config) -> WorkerKind:
    """Return the kind of a worker: of another one, or of this process."""
    return WorkerKind[getattr(node, "workerinput", {}).get(_KIND, WorkerKind.ALL.name)]


def ignores(file: Path, config: pytest.Config) -> bool:
    """Return True if this worker runs no test of a file."""
    kind = kind_of(config)
    if kind == WorkerKind.ALL or not file.is_file():
        return False
    return computes(file.relative_to(config.rootpath).as_posix()) != (kind == WorkerKind.BACKGROUND)


def lower_priority(config: pytest.Config) -> None:
    """Lower the priority of this process if it is a worker in the background."""
    if kind_of(config) == WorkerKind.BACKGROUND and hasattr(os, "nice"):
        os.nice(_LOWEST_PRIORITY)
        if _AUTOGROUP.exists():
            os.setsid()
            _AUTOGROUP.write_text(str(_LOWEST_PRIORITY))


class Scheduling(LoadGroupScheduling):  # type: ignore[misc]  # pytest-xdist has no types
    """`--dist loadgroup` with workers that have different tests: in the foreground, in reserve, in the background."""

    def __init__(self, config: pytest.Config, log: Producer) -> None:
        super().__init__(config, log)
        self.collection: list[str] | None = None
        self._scopes: dict[str, str] = {}
        self._short: Counter[str] = Counter()

    def add_node_collection(self, node: WorkerController, collection: Sequence[str]) -> None:
        """Take the tests that a worker has collected."""
        self.registered_collections[node] = list(collection)

    def schedule(self) -> None:
        """Give each worker its first tests when all have collected, or more tests later."""
        if self.collection is None:
            if not self._check_nodes_have_same_collection():
                return
            self.collection = tests = list(dict.fromkeys(chain.from_iterable(self.registered_collections.values())))
            self.config.stash[SESSION].testscollected = len(tests)  # pytest shows a share of it
            for nodeid in tests:
                self.workqueue.setdefault(self._split_scope(nodeid), {})[nodeid] = False
        for node in self.nodes:
            self._reschedule(node)
            self._reschedule(node)  # a worker begins a test when it knows the next one

    def _check_nodes_have_same_collection(self) -> bool:
        """Return True if the workers with the same tests to collect have collected the same tests."""
        firsts: dict[bool, list[str]] = {}
        for node, collection in self.registered_collections.items():
            if firsts.setdefault(kind_of(node) == WorkerKind.BACKGROUND, collection) != collection:
                return bool(super()._check_nodes_have_same_collection())  # it says what differs
        return True

    def _split_scope(self, nodeid: str) -> str:
        """Return the work unit of a test."""
        if nodeid not in self._scopes:  # pytest-xdist asks in the order of the tests
            scope: str = super()._split_scope(nodeid)
            if scope == nodeid and computes(nodeid) and not nodeid.startswith(_LONG):
                file, _, _ = nodeid.partition("::")
                scope = f"{file} {self._short[file] // _ASSIGNED_TOGETHER}"
                self._short[file] += 1
            self._scopes[nodeid] = scope
        return self._scopes[nodeid]

    def _reschedule(self, node: WorkerController) -> None:
        """Give a worker one more work unit if it has few tests left. End it if there are none for it."""
        kind = kind_of(node)
        if node.shutting_down or node not in self.registered_collections:  # it comes for one that crashed
            return
        if kind == WorkerKind.RESERVE and self._has_work(WorkerKind.BACKGROUND):
            return
        if not self._has_work(kind):
            node.shutdown()
            if kind == WorkerKind.BACKGROUND:
                self._call_reserve()
        elif self._pending_of(self.assigned_work[node]) <= _FEW:
            if kind == WorkerKind.BACKGROUND:
                self.workqueue.move_to_end(next(reversed(self.workqueue)), last=False)
            self._assign_work_unit(node)

    def _has_work(self, kind: WorkerKind) -> bool:
        """Return True if work units wait for a kind of worker. `sort` has put those that compute last."""
        if not self.workqueue or kind == WorkerKind.ALL:
            return bool(self.workqueue)
        units = reversed(self.workqueue) if kind == WorkerKind.BACKGROUND else iter(self.workqueue)
        first = next(iter(self.workqueue[next(units)]))
        return computes(first) == (kind == WorkerKind.BACKGROUND)

    def _call_reserve(self) -> None:
        """Give the workers in reserve their first tests."""
        for node in self.nodes:
            if kind_of(node) == WorkerKind.RESERVE:
                self._reschedule(node)
                self._reschedule(node)
