"""Threads of jobs: as many as jobs run, at most the limit, and none afterwards."""

import threading
from concurrent.futures import CancelledError

import pytest

from fleet.client.job_threads import JobThreads
from tests.support.processes import wait_for

LIMIT = 4


def alive(name: str) -> int:
    """Return the number of threads with this name."""
    return sum(thread.name == name for thread in threading.enumerate())


def test_each_job_has_a_thread_that_ends_with_it() -> None:
    threads, over, running = JobThreads(LIMIT, "job-a"), threading.Event(), threading.Semaphore(0)

    def job(number: int) -> int:
        running.release()
        assert over.wait(30)
        return number

    futures = [threads.submit(job, number) for number in range(3 * LIMIT)]
    for _ in range(LIMIT):
        assert running.acquire(timeout=30)
    assert alive("job-a") == LIMIT
    over.set()
    assert [future.result(30) for future in futures] == list(range(3 * LIMIT))
    wait_for(lambda: alive("job-a") == 0, "the threads have ended")
    assert threads.submit(job, 7).result(30) == 7


def test_job_error_is_its_result_and_next_job_runs() -> None:
    threads = JobThreads(1, "job-b")

    def fail() -> None:
        raise LookupError("no such car")

    with pytest.raises(LookupError):
        threads.submit(fail).result(30)
    assert threads.submit(max, 1, 2).result(30) == 2


def test_shutdown_drops_waiting_jobs_and_waits_for_running_ones() -> None:
    threads, begun, over = JobThreads(1, "job-c"), threading.Event(), threading.Event()

    def job() -> None:
        begun.set()
        assert over.wait(30)

    runs, waits = threads.submit(job), threads.submit(job)
    assert begun.wait(30)
    threads.shutdown(wait=False, cancel_futures=True)
    with pytest.raises(CancelledError):
        waits.result(30)
    with pytest.raises(RuntimeError):
        threads.submit(job)
    over.set()
    threads.shutdown()
    assert runs.done()
    assert alive("job-c") == 0
