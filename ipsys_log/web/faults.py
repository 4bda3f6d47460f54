"""Faults of the page's server: kept for the end of the command, because the screen belongs to a recording."""

from __future__ import annotations

import asyncio
import traceback
from typing import Any

from starlette.types import ASGIApp, Receive, Scope, Send

__all__ = ["Faults"]


class Faults:
    """Unexpected exceptions in the server's thread: their number, and the first one's traceback."""

    def __init__(self) -> None:
        self.count = 0
        self.first = ""

    def add(self, error: BaseException) -> None:
        """Count an exception."""
        while isinstance(error, BaseExceptionGroup) and len(error.exceptions) == 1:
            (error,) = error.exceptions
        self.count += 1
        self.first = self.first or "".join(traceback.format_exception(error)).rstrip()

    def watch_loop(self, loop: asyncio.AbstractEventLoop) -> None:
        """Count exceptions that nothing else in an event loop handles."""

        def handle(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
            self.add(context.get("exception") or RuntimeError(str(context.get("message"))))

        loop.set_exception_handler(handle)

    def watch_app(self, app: ASGIApp) -> ASGIApp:
        """Count exceptions of an app; the server answers such a request with the status 500."""

        async def call(scope: Scope, receive: Receive, send: Send) -> None:
            try:
                await app(scope, receive, send)
            except Exception as error:
                self.add(error)

        return call
