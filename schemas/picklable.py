"""Errors that can be returned by another process, such as a worker of `concurrent.futures`."""

from typing import Any


class Picklable:
    """Mix it in before the base of an error whose constructor takes other arguments than the text.

    Pickle makes an error again by calling its class with the text alone. Where that fails, a pool of processes breaks.
    """

    args: tuple[Any, ...]

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how to make the error again without its constructor."""
        return _make_again, (type(self), self.args), self.__dict__


def _make_again(error: type[BaseException], args: tuple[Any, ...]) -> BaseException:
    again = error.__new__(error, *args)
    again.args = args  # an OSError leaves that to its constructor
    return again
