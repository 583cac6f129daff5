"""Accepts the URL of a link from the command line."""

from importlib.util import find_spec

from gateway.link.base import BadUrl
from schemas.links import BadLink, BleUrl, LinkUrl, parse_link
from schemas.suggestion import how_to_install


def parse_url(text: str) -> LinkUrl:
    """Return the link with this URL or bare device path; raise BadUrl."""
    try:
        url = parse_link(text)
    except BadLink as error:
        raise BadUrl(f"link {text[:80]!r}: {error}") from None
    # Refused here, so that no gateway starts for a link that it can never open.
    if isinstance(url, BleUrl) and find_spec("bleak") is None:
        raise BadUrl(f"link {text!r} needs Bluetooth, which is not installed: {how_to_install('ble')}")
    return url
