"""Errors of the bus. Each text names the endpoint and what to do."""


class BusError(Exception):
    """The bus is not available. The text names the endpoint and what to do."""


class NoFleet(BusError):
    """Nothing listens at the endpoint."""

    def __init__(self, words: str, endpoint: str) -> None:
        super().__init__(words)
        self.endpoint = endpoint


class HubUnreachable(NoFleet):
    """Nothing answers at an endpoint of another computer. It is not known whether cars move there."""


class BadEndpoint(BusError):
    """An endpoint that is invalid for Zenoh, or at which no hub may listen."""
