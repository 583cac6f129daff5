"""Key expressions as Zenoh writes and compares them."""

import zenoh

from schemas.keys import BadKey


def canon(expression: str) -> str:
    """Return the canonical form of a key expression. Raises BadKey if it is invalid for Zenoh."""
    try:
        return str(zenoh.KeyExpr.autocanonize(expression))
    except zenoh.ZError as error:
        words = str(error).partition(" at /")[0]  # cuts a position in Zenoh's source
        raise BadKey(f"key expression {expression!r} is not allowed: {words}") from None


def intersects(one: str, other: str) -> bool:
    """Return True if some key matches both expressions, which must be canonical."""
    return bool(zenoh.KeyExpr(one).intersects(zenoh.KeyExpr(other)))
