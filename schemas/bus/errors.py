"""Errors of the bus; each names the endpoint and what to do."""


class BusError(Exception):
    """The bus cannot be had; its text names the endpoint and what to do."""


class NoFleet(BusError):
    """Nothing listens at the endpoint."""


class BadEndpoint(BusError):
    """An endpoint that Zenoh cannot take, or at which no hub may listen."""
