"""Assigns tests to workers of pytest-xdist.

Tests that compute have workers of their own, in the background, with a low priority. The other tests have the
foreground: they mostly wait for processes, cars and seconds. The background is done first, because it gets all the time
that the foreground leaves. From then on, half of that time would be lost. So there are workers in reserve, which help
the foreground when the background is done.
"""

import os
from collections import Counter
from collections.abc import Iterable
from enum import Enum, auto
from functools import cached_property
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
_MIN_WAITING: Final = 1000
"""Minimum number of tests that do not only compute, for workers of different kinds. With fewer, all workers are of the
foreground: beside workers that compute, those in the background would get no time."""
_LOWEST_PRIORITY: Final = 19
_COMPUTING_TIMEOUT_S: Final = 600
"""Timeout of a test that computes. In the background it waits for all other processes: on a machine with other work, a
test of 6 s took more than the 120 s of the other tests."""
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
    """Which tests a worker runs."""

    FOREGROUND = auto()
    """All tests, first those that do not only compute."""
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


def are_divided(workers: int, tests: Iterable[str]) -> bool:
    """Return True if the workers are of different kinds in a run of tests with these ids."""
    return workers == WORKERS and sum(not computes(each) for each in tests) >= _MIN_WAITING


def kind_of(worker: str) -> WorkerKind:
    """Return the kind of a worker (such as `gw7`) if the workers are divided."""
    index = int(worker.removeprefix("gw"))
    if index < _FOREGROUND:
        return WorkerKind.FOREGROUND
    return WorkerKind.RESERVE if index < _FOREGROUND + _RESERVE else WorkerKind.BACKGROUND


def lower_priority(config: pytest.Config, tests: Iterable[str]) -> None:
    """Lower the priority of this process if it is a worker in the background."""
    given = getattr(config, "workerinput", None)
    if given is None or not hasattr(os, "nice"):
        return
    if kind_of(given["workerid"]) == WorkerKind.BACKGROUND and are_divided(given["workercount"], tests):
        os.nice(_LOWEST_PRIORITY)
        if _AUTOGROUP.exists():
            os.setsid()
            _AUTOGROUP.write_text(str(_LOWEST_PRIORITY))


class Scheduling(LoadGroupScheduling):  # type: ignore[misc]  # pytest-xdist has no types
    """`--dist loadgroup` with workers in the background, and in reserve."""

    def __init__(self, config: pytest.Config, log: Producer) -> None:
        super().__init__(config, log)
        config.option.loadscopereorder = False  # `sort` has done it
        self._scopes: dict[str, str] = {}
        self._short: Counter[str] = Counter()

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

    def _assign_work_unit(self, node: WorkerController) -> None:
        # tests/conftest.py has sorted the tests that compute to the end.
        last = next(reversed(self.workqueue))
        background_has_tests = computes(next(iter(self.workqueue[last])))
        kind = self._kind_of(node)
        if kind == WorkerKind.RESERVE and background_has_tests:
            return
        if kind == WorkerKind.BACKGROUND:
            if not background_has_tests:
                # Processes that this worker started would have low priority, too. So it takes no other tests.
                node.shutdown()
                self._call_reserve()
                return
            self.workqueue.move_to_end(last, last=False)
        super()._assign_work_unit(node)

    def _call_reserve(self) -> None:
        """Give the workers in reserve their first tests."""
        for node in self.nodes:
            if self._kind_of(node) == WorkerKind.RESERVE:
                self._reschedule(node)
                self._reschedule(node)  # a worker begins a test when it knows the next one

    def _kind_of(self, node: WorkerController) -> WorkerKind:
        """Return the kind of a worker."""
        return kind_of(node.gateway.id) if self._are_divided else WorkerKind.FOREGROUND

    @cached_property
    def _are_divided(self) -> bool:
        return are_divided(self.numnodes, self.collection or ())
