"""Requests of the pages: who may read and write, which device operates, their JSON, and their errors."""

import hmac
import json
import secrets
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any
from urllib.parse import parse_qs

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ipsys_log.errors import IpsysError
from ipsys_log.sinks.streams.addresses import is_own_host

# Only a script of the page can send this header. Before another site sends it, the browser asks this server.
HEADER = "x-ipsys"
# The key in the scope of an accepted request: True if requests of this device may write.
MAY_WRITE = "ipsys.may_write"

_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'; "
    "base-uri 'none'; form-action 'self'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class Guard:
    """A guard that refuses requests before they reach the app.

    Parameters
    ----------
    app : the guarded app.
    names : host names of this machine, besides ``localhost`` and plain IP addresses. The guard refuses other
        names that lead to this machine (DNS rebinding).
    token : token of the first request as ``?token=``, and of the cookie of later requests. None: no token is
        needed.
    view_token : a second token, for devices that may only read. None: there is no such token.
    """

    def __init__(
        self, app: ASGIApp, names: frozenset[str], token: str | None, view_token: str | None = None
    ) -> None:
        self._app, self._token = app, token
        self._tokens = [one for one in (token, view_token) if one is not None]
        self._names = names | {"localhost"}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        refusal = self._refusal(scope)
        app = self._app if refusal is None else refusal

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        await app(scope, receive, with_headers)

    def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if not is_own_host(host, self._names):
            return _refuse("this is not an address of this machine")
        scope[MAY_WRITE] = True
        if self._token is not None:
            token = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
            if scope["method"] == "GET" and scope["path"] == "/" and _is_one_of(token, self._tokens):
                return self._welcome(scope, token)
            cookie = Request(scope).cookies.get(self._name(scope), "")
            if not _is_one_of(cookie, self._tokens):
                return _refuse("open the page with the full address that ipsys printed")
            scope[MAY_WRITE] = _is_one_of(cookie, [self._token])
        if scope["method"] not in ("GET", "HEAD"):
            origin = headers.get("origin")
            if headers.get(HEADER) != "1" or (origin is not None and origin != f"http://{host}"):
                return _refuse("only the page of ipsys may write")
            if not scope[MAY_WRITE]:
                return _refuse("this device may only view; open the address to operate that ipsys printed")
        return None

    def _welcome(self, scope: Scope, token: str) -> Response:
        """Move the token from the address line, where other people could read it, to a cookie."""
        response = RedirectResponse("/", 303)
        response.set_cookie(self._name(scope), token, httponly=True, samesite="strict")
        return response

    @staticmethod
    def _name(scope: Scope) -> str:
        """Return the name of the cookie, with the port.

        Browsers send a cookie to all ports of a host. Two pages on one machine must not share a cookie.
        """
        return f"ipsys_{(scope.get('server') or ('', 0))[1]}"


def _is_one_of(given: str, tokens: Iterable[str]) -> bool:
    return any(hmac.compare_digest(given.encode(), token.encode()) for token in tokens)


def _refuse(text: str) -> Response:
    """Refuse a request and close the connection: only a user of the page may keep a connection open."""
    return PlainTextResponse(text, 403, headers={"Connection": "close"})


_NUMBERS = 1 << 30


class OperatorSeat:
    """The seat of the operator. For one thread.

    Numbers begin anywhere: a page of an earlier server does not have the number of a present device.

    Attributes
    ----------
    number : the number of the device that operates; 0: none.
    version : increases with each change.
    """

    def __init__(self) -> None:
        self.number, self.version = 0, 0
        self._last = secrets.randbelow(_NUMBERS)

    def claim(self, take_over: bool) -> int:
        """Return the number of a new operator; it takes an occupied seat only by ``take_over``."""
        if self.number and not take_over:
            raise IpsysError(_OCCUPIED)
        self._last += 1
        self.number = self._last
        self.version += 1
        return self.number

    def release(self, number: int) -> None:
        """End the operation by a device, if it still operates."""
        if number == self.number:
            self.number = 0
            self.version += 1

    def check(self, number: int) -> None:
        """Check that a device operates, and no other."""
        if not number or number != self.number:
            raise IpsysError(_OCCUPIED)


_OCCUPIED = "another device operates; press 'Take over' to operate from this device"


def operator_of(body: Mapping[str, Any], key: str = "operator") -> int:
    """Return the number of the device that sends a request; 0 if it names none."""
    value = body.get(key)
    return value if isinstance(value, int) and not isinstance(value, bool) else 0


def answer_claim(seat: OperatorSeat, body: Mapping[str, Any]) -> dict[str, int]:
    """Claim the seat for a device if it is free or taken over, or release it; return the answer."""
    if "release" in body:
        seat.release(operator_of(body, "release"))
        return {}
    return {"operator": seat.claim(body.get("take_over") is True)}


_LARGEST = 16 << 10
MOST_DIGITS = 20


def file_routes(
    page: str, scripts: Sequence[str], folder: str = "", shared: Sequence[str] = ()
) -> Iterator[Route]:
    """Yield the routes of the files of a page: its HTML, its styles and its scripts.

    Parameters
    ----------
    page : the name of the HTML and of the styles, which are in ``folder`` below this package.
    scripts, shared : names of the scripts in ``folder``, and of those beside this module.
    """
    own, here = files("ipsys_log.app.web").joinpath(folder), files("ipsys_log.app.web")
    yield _file_route("/", own.joinpath(f"{page}.html"), "text/html")
    yield _file_route(f"/{page}.css", own.joinpath(f"{page}.css"), "text/css")
    yield _file_route("/theme.css", here.joinpath("theme.css"), "text/css")
    for place, names in ((own, scripts), (here, shared)):
        for name in names:
            yield _file_route(f"/{name}.js", place.joinpath(f"{name}.js"), "text/javascript")


def _file_route(path: str, file: Traversable, kind: str) -> Route:
    content = file.read_bytes()

    async def answer(_: Request) -> Response:
        return Response(content, media_type=kind)

    return Route(path, answer)


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
