"""The exceptions of links. Each message is one line for a person: what, where, what to do."""


class LinkError(Exception):
    """A link cannot be opened, or is lost. The message is one line for a person: what, where, what to do."""


class BadUrl(LinkError):
    """The URL names no link. This is wrong use."""


class CannotOpen(LinkError):
    """The link was not opened. Nothing was sent."""


class Busy(CannotOpen):
    """Another program has the port."""


class LinkLost(LinkError):
    """The link is lost. A write that raises this may have sent all, some or none of its bytes."""


class CannotList(Exception):
    """The devices of a kind cannot be listed. The message is one line: why, what to do."""
