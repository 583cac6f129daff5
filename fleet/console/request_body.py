"""Reads the bodies of HTTP requests, at most as much of them as is allowed."""

import asyncio
from typing import Final

from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request

BODY_TIMEOUT_S: Final = 10.0
"""Timeout of a body, from the first wait for it."""


async def read_start(request: Request, size: int) -> bytes:
    """Return the first `size` bytes of the body. The rest is not read. Raises HTTPException if they do not come."""
    # A client that breaks off is no error of the console. Without this, uvicorn would log each case with a traceback.
    body = b""
    try:
        async with asyncio.timeout(BODY_TIMEOUT_S):
            async for part in request.stream():
                body += part
                if len(body) >= size:
                    break
    except TimeoutError:
        raise HTTPException(408, "the body of the request did not come", {"connection": "close"}) from None
    except ClientDisconnect:
        raise HTTPException(400, "the request ended before its body") from None
    return body[:size]


async def read_text(request: Request, max_bytes: int) -> str | None:
    """Return the body of a request. None if it is too large. Raises HTTPException if it does not come."""
    body = await read_start(request, max_bytes + 1)
    return None if len(body) > max_bytes else body.decode("utf-8", "replace")
