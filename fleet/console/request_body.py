"""Reads the bodies of HTTP requests, at most as much of them as is allowed."""

from starlette.requests import Request


async def read_start(request: Request, size: int) -> bytes:
    """Return the first `size` bytes of the body. The rest is not read."""
    body = b""
    async for part in request.stream():
        body += part
        if len(body) >= size:
            break
    return body[:size]


async def read_text(request: Request, max_bytes: int) -> str | None:
    """Return the body of a request. None if it is too large."""
    body = await read_start(request, max_bytes + 1)
    return None if len(body) > max_bytes else body.decode("utf-8", "replace")
