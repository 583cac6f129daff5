"""Accepts the URL of a link from the command line."""

from gateway.link.link_exceptions import BadUrl
from schemas.links import BadLink, LinkUrl, parse_link


def parse_url(text: str) -> LinkUrl:
    """Return the link with this URL or bare device path. Raises BadUrl if it is none, or if a package is missing."""
    try:
        url = parse_link(text)
    except BadLink as error:
        raise BadUrl(f"link {text[:80]!r}: {error}") from None
    # Refuse it here, so that no gateway starts for a link that it can never open.
    if missing := url.missing():
        raise BadUrl(f"link {text!r} {missing}")
    return url
