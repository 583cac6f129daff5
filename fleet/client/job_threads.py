"""Threads that end when no job waits. `ThreadPoolExecutor` keeps every thread that it ever started."""

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any


class JobThreads:
    """Starts a thread for each job, up to a limit. Further jobs wait for the first thread that is free.

    Many jobs at once cost threads and memory only while they run.

    Args:
        limit: Maximum number of threads.
        name: Name of the threads.
    """

    def __init__(self, limit: int, name: str) -> None:
        self._limit, self._name = limit, name
        self._lock = threading.Lock()
        self._waiting: deque[tuple[Future[Any], Callable[[], Any]]] = deque()
        self._running: set[threading.Thread] = set()
        self._closed = False

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run this on a thread. Raises RuntimeError after `shutdown`."""
        future: Future[Any] = Future()
        job = future, lambda: fn(*args, **kwargs)
        with self._lock:
            if self._closed:
                raise RuntimeError("no new jobs after shutdown")
            if len(self._running) < self._limit:
                thread = threading.Thread(target=self._run, args=job, name=self._name)
                thread.start()
                self._running.add(thread)
            else:
                self._waiting.append(job)
        return future

    def shutdown(self, *, wait: bool = True, cancel_futures: bool = False) -> None:
        """Accept no new job. With `cancel_futures`, drop the jobs that wait for a thread.

        With `wait`, wait until all other jobs end.
        """
        with self._lock:
            self._closed = True
            if cancel_futures:
                for future, _ in self._waiting:
                    future.cancel()
        while wait and (running := list(self._running)):
            for thread in running:
                thread.join()

    def _run(self, future: Future[Any], call: Callable[[], Any]) -> None:
        while True:
            if future.set_running_or_notify_cancel():
                try:
                    future.set_result(call())
                except BaseException as error:  # noqa: BLE001 - `Future.result` raises it
                    future.set_exception(error)
            with self._lock:
                if not self._waiting:
                    self._running.discard(threading.current_thread())
                    return
                future, call = self._waiting.popleft()
