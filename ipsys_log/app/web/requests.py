"""Requests of the pages: their JSON and numbers, the files of a page, and the answers to errors."""

from __future__ import annotations

import json
from collections.abc import Callable, Coroutine, Mapping
from importlib.resources import files
from typing import Any

from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response

from ipsys_log.errors import IpsysError

Answer = Callable[[Request], Coroutine[Any, Any, Response]]

_LARGEST = 16 << 10
MOST_DIGITS = 20


def answer_file(name: str, kind: str, package: str = "ipsys_log.app.web") -> Answer:
    """Return a handler that answers with a file of a package; ``kind`` is its media type."""
    content = files(package).joinpath(name).read_bytes()

    async def answer(_: Request) -> Response:
        return Response(content, media_type=kind)

    return answer


def whole_number(text: str) -> int | None:
    """Return the number in a request; None for other values, and for too many digits."""
    return int(text) if text.isascii() and text.isdecimal() and len(text) <= MOST_DIGITS else None


async def read_json(request: Request) -> dict[str, Any]:
    """Return the JSON object in the body of a request.

    Raises
    ------
    IpsysError
        The body is too large, or is not a JSON object.
    """
    data = b""
    async for part in request.stream():
        data += part
        if len(data) > _LARGEST:
            raise IpsysError("the request is too large")
    try:
        body = json.loads(data)
        json.dumps(body, ensure_ascii=False).encode()  # raises for half of a surrogate pair
    except (ValueError, RecursionError) as error:
        raise IpsysError("the request is not JSON") from error
    if not isinstance(body, dict):
        raise IpsysError("the request is not a JSON object")
    return body


async def _handle_refusal(_: Request, error: Exception) -> Response:
    return JSONResponse({"error": str(error)}, 400)


async def _handle_disconnect(_: Request, __: Exception) -> Response:
    return Response(status_code=400)  # the client has disconnected


async def _handle_failure(_: Request, error: Exception) -> Response:
    text = (
        f"internal error of ipsys: {type(error).__name__}: {error}; the terminal shows "
        "it when the command ends"
    )
    return JSONResponse({"error": text}, 500)


ERROR_HANDLERS: Mapping[Any, Any] = {
    IpsysError: _handle_refusal,
    ClientDisconnect: _handle_disconnect,
    Exception: _handle_failure,
}
