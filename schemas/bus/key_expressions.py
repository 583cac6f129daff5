"""Key expressions as Zenoh writes and compares them."""

import zenoh

from schemas.keys import BadKey


def canon(expression: str) -> str:
    """A key expression as Zenoh writes it; raises BadKey for one that Zenoh does not take."""
    try:
        return str(zenoh.KeyExpr.autocanonize(expression))
    except zenoh.ZError as error:
        words = str(error).partition(" at /")[0]  # what follows is a place in Zenoh's source
        raise BadKey(f"key expression {expression!r} is not allowed: {words}") from None


def intersects(one: str, other: str) -> bool:
    """Whether some key matches both expressions; each must be as `canon` gives it."""
    return bool(zenoh.KeyExpr(one).intersects(zenoh.KeyExpr(other)))
