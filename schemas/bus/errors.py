"""Errors of the bus. Each text says what is wrong, and most say what to do."""

from schemas.picklable import Picklable


class BusError(Exception):
    """The bus is not available, or a file of its hub cannot be used. The text says why."""


class NoFleet(Picklable, BusError):
    """Nothing listens at the endpoint."""

    def __init__(self, words: str, endpoint: str) -> None:
        super().__init__(words)
        self.endpoint = endpoint


class HubUnreachable(NoFleet):
    """Nothing answers at an endpoint of another computer. It is not known whether cars move there."""


class BadEndpoint(BusError):
    """An endpoint that is invalid for Zenoh, or at which a hub is not allowed to listen."""
