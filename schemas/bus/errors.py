"""Errors of the bus. Each text names the endpoint and what to do."""


class BusError(Exception):
    """The bus is not available. The text names the endpoint and what to do."""


class NoFleet(BusError):
    """Nothing listens at the endpoint."""


class BadEndpoint(BusError):
    """An endpoint that is invalid for Zenoh, or at which no hub may listen."""
