"""The coordinator's mode and color commands that have no outcome yet, and the last failures."""

from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

from fleet.client.client import Fleet
from fleet.client.commands import led_request, mode_request
from fleet.client.outcome import Outcome
from fleet.policy.decide import CarCommand


class OpenCommands:
    """The open commands of one coordinator. Reports each new failure once."""

    def __init__(self, client: Fleet, on_failure: Callable[[str], None]) -> None:
        self._client = client
        self._on_failure = on_failure
        self._modes: dict[str, tuple[CarCommand, Future[list[Outcome]]]] = {}
        self._leds: list[tuple[CarCommand, Future[list[Outcome]]]] = []
        self._last_failures: dict[str, str] = {}

    @property
    def busy(self) -> Collection[str]:
        """The cars whose mode command has no outcome yet."""
        return self._modes.keys()

    def send(self, commands: Iterable[CarCommand], pool: ThreadPoolExecutor) -> None:
        """Send commands. Skip a color of a blinking LED if the car's last color command has no outcome yet."""
        for command in commands:
            if command.blink and any(command.car == other.car for other, _ in self._leds):
                continue  # the link or the car is too slow for this blinking
            request = (
                mode_request(command.mode) if command.mode is not None else led_request(*(command.led or (0, 0, 0)))
            )
            future = pool.submit(self._client.ask, request, [command.car])
            if command.mode is not None:
                self._modes[command.car] = (command, future)
            else:
                self._leds.append((command, future))

    def outcomes(self) -> Iterator[tuple[CarCommand, Outcome]]:
        """Yield the mode commands that have an outcome by now."""
        for car, (command, future) in list(self._modes.items()):
            if future.done():
                del self._modes[car]
                outcome = future.result()[0]
                yield command, outcome
                self._note(car, "" if outcome.ok else f"{car}: {_words(outcome)}")
        for command, future in [each for each in self._leds if each[1].done()]:
            self._leds.remove((command, future))
            outcome = future.result()[0]
            self._note(
                f"{command.car} led", "" if outcome.ok else f"{command.car}: the color of a rule: {_words(outcome)}"
            )

    def forget(self, cars: Iterable[str]) -> None:
        """Forget the failures of these cars."""
        for car in cars:
            self._last_failures.pop(car, None)
            self._last_failures.pop(f"{car} led", None)

    def _note(self, what: str, words: str) -> None:
        if words and words != self._last_failures.get(what):  # a blinking LED may fail every second: report it once
            self._on_failure(words)
        self._last_failures[what] = words


def _words(outcome: Outcome) -> str:
    return f"{outcome.reason or outcome.phase}: {outcome.words}"
