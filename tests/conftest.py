"""Collects tests, spreads them over workers, removes the deadline of Hypothesis' examples, sets signals and logging."""

import gc
import logging
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, settings
from xdist.remote import Producer
from xdist.workermanage import WorkerController

from tests.support import scheduling
from tests.support.signals import give_default_signals

if TYPE_CHECKING:
    from tests.support.processes import FleetProcesses

# By default, Hypothesis fails an example that takes 200 ms, and a test whose examples take a second to generate. A
# stall of the machine is no fault of the product. pytest's timeout ends an endless example.
settings.register_profile(
    "patient",
    parent=settings(),
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("patient")

give_default_signals()


def pytest_xdist_auto_num_workers() -> int:
    """Return the number of workers for `-n auto`."""
    return scheduling.WORKERS


def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> scheduling.Scheduling:
    """Use `--dist loadgroup` with workers in the background."""
    return scheduling.Scheduling(config, log)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect without the garbage collector, which took half of the time for thousands of tests."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_configure(config: pytest.Config) -> None:
    """Visit each folder only once: pytest 9.1 does not find the fixtures of a folder to which it comes back."""
    config.args.sort()


def pytest_sessionstart(session: pytest.Session) -> None:
    """Let the scheduler find the session."""
    session.config.stash[scheduling.SESSION] = session


def pytest_configure_node(node: WorkerController) -> None:
    """Tell a worker of pytest-xdist its kind."""
    scheduling.choose_kind(node)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not collect a file whose tests are for other workers."""
    return True if scheduling.ignores(collection_path, config) else None


def pytest_collection_finish(session: pytest.Session) -> None:
    """Lower the priority of a worker in the background."""
    scheduling.lower_priority(session.config)


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist reads the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keep tests that share a fixture of their module on one worker.

    Without a group, every worker gets some of these tests, and starts the fleet or records the session once more.
    """
    for item in items:
        if isinstance(item, pytest.Function) and item.get_closest_marker("xdist_group") is None:
            definitions = item._fixtureinfo.name2fixturedefs.values()
            used = (each for several in definitions for each in several if each.baseid.startswith("tests"))
            if any(each.scope == "module" for each in used):
                item.add_marker(pytest.mark.xdist_group(item.nodeid.partition("::")[0]))
    scheduling.sort(items)


def pytest_runtest_teardown() -> None:
    """Enable logging again, which the completion of a shell disables for the rest of its process."""
    if logging.root.manager.disable:  # to set it costs each test a look at each logger
        logging.disable(logging.NOTSET)


@pytest.fixture
def fleet(tmp_path: Path) -> "Iterator[FleetProcesses]":
    """Start a hub for the processes of one test, and end them all."""
    from tests.support.ports import free_endpoint  # here, because most tests need no process
    from tests.support.processes import FleetProcesses

    started = FleetProcesses(free_endpoint(), tmp_path)
    yield started
    started.close()
