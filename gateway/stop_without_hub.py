"""Stops a car without the bus, over a link of its own and with a new driver.

It is needed twice:

- A gateway starts while its hub is away, and the car may still follow its last command. Suppose systemd's watchdog
  ended a gateway during an outage of the network. The next gateway waits for the hub first, and would leave a moving
  car alone.
- A gateway fails, perhaps because its driver does, which may come from another package. Such a driver may write no
  frames any more.

Nothing here reads from the bus or publishes on it.
"""

import asyncio
import contextlib
import logging
import sys
import time
from functools import partial
from pathlib import Path
from typing import Final

from gateway import drivers
from gateway.control.controller import Controller
from gateway.control.driver import Driver
from gateway.learned_file import LearnedFile
from gateway.link import Link, LinkError, LinkLost, LinkUrl, open_link
from gateway.link_loop import at_rate
from schemas.links import car_link
from schemas.process import signals

log = logging.getLogger("gateway")

_STOP_POLL_S: Final = 0.05
"""Interval at which the driver is asked for its next frame. Frames are tens of milliseconds apart."""


def run_stop_alone(car: str, url: LinkUrl, platform: str, fleet: str, state_dir: Path) -> str:
    """Run `stop_alone` in an event loop of its own. Ctrl-C waits for its end. Then the result is printed at once."""
    with signals.held_back() as came:
        words = asyncio.run(stop_alone(car, url, platform, fleet, state_dir))
        if came:
            sys.stderr.write(f"gateway: {words}\n")
    return words


async def stop_alone(car: str, url: LinkUrl, platform: str, fleet: str, state_dir: Path) -> str:
    """Stop the car without the bus. Return a sentence for a person that says whether it was stopped."""
    try:
        why_not = await _stop(car, url, platform, fleet, state_dir)
    except LinkError as error:
        return f"{car} may be moving, and was not stopped: {error}"
    except Exception as error:  # a driver may fail again
        log.exception("%s could not be stopped", car)
        return f"{car} may be moving, and was not stopped: {type(error).__name__}: {error}"
    return f"{car} may be moving: {why_not}" if why_not else f"{car} was stopped without the bus."


async def _stop(car: str, url: LinkUrl, platform: str, fleet: str, state_dir: Path) -> str:
    """Open the link, stop the car, close the link. Return why it was not stopped, empty if it was. Raises LinkError."""
    learned = LearnedFile(state_dir, fleet, car, link=car_link(url), platform=platform)
    loop = asyncio.get_running_loop()
    make = learned.load(partial(drivers.driver_of, platform))
    control = Controller[Driver](car, make, now=loop.time(), now_ns=time.time_ns())
    driver = control.driver
    link = await open_link(at_rate(url, driver.model.profile.baud), first=True)
    control.link_up(loop.time())
    driver.shut_down(loop.time())
    reads = asyncio.ensure_future(_read(link, driver))
    reads.add_done_callback(partial(_log_deaf, car))
    try:
        while not driver.finished:
            await _write(link, driver)
            if reads.done() and isinstance(reads.exception(), LinkLost):
                reads.result()
            await asyncio.sleep(_STOP_POLL_S)
            control.tick(loop.time())
    except LinkLost as error:
        driver.link_down(str(error), loop.time())
    finally:
        reads.cancel()
        with contextlib.suppress(asyncio.CancelledError, Exception):  # a driver that cannot read can still write a stop
            await reads
        await link.close()
    return driver.not_stopped


def _log_deaf(car: str, reads: asyncio.Task[None]) -> None:
    """Log why the driver reads nothing any more, unless the link is lost, or the stop is over."""
    error = None if reads.cancelled() else reads.exception()
    if error is not None and not isinstance(error, LinkLost):
        log.error("the driver of %s failed to read: nothing it sends can show its stop", car, exc_info=error)


async def _read(link: Link, driver: Driver) -> None:
    loop = asyncio.get_running_loop()
    while True:
        data = await link.read()
        for event in driver.feed(data, loop.time()):
            driver.on_event(event, loop.time())


async def _write(link: Link, driver: Driver) -> None:
    loop = asyncio.get_running_loop()
    for event in driver.flush(loop.time()):
        driver.on_event(event, loop.time())
    while (write := driver.poll(loop.time())) is not None:
        driver.sends(write.data, loop.time())
        await link.write(write.data)
        driver.on_written(write, loop.time())
