"""HTTP requests that a server of WebSockets does not know: any but GET, and any of HTTP 1.0.

websockets 17 reads them all, but viser, to 1.1.1, asks for an older one.
"""

import contextlib
import functools
import re
from collections.abc import Iterator
from http import HTTPStatus
from typing import Any

import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

_LONGEST_LINE = 8192  # bytes


class Connection(ServerConnection):
    """A connection that turns the first line of any HTTP request into that of a GET; `answer` does the rest."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.method, self._begun = b"", b""

    def data_received(self, data: bytes) -> None:
        """Receives some bytes from asyncio."""
        if not self.method:
            self._begun += data
            line, newline, rest = self._begun.partition(b"\n")
            if not newline and len(line) < _LONGEST_LINE:
                return
            request = re.fullmatch(rb"([A-Z]+) (\S+) HTTP/1\.[01]\r?", line)
            self.method = request[1] if request else b"GET"  # what is no request is refused as one
            data = b"GET %b HTTP/1.1\r\n%b" % (request[2], rest) if request else self._begun
            if self.method not in (b"GET", b"HEAD"):  # whose body would not be understood
                data = b"GET / HTTP/1.1\r\n\r\n"
        elif self.method not in (b"GET", b"HEAD"):
            return
        super().data_received(data)


def answer(connection: ServerConnection, request: Request, response: Response) -> Response | None:
    """Returns the response to the method that was asked for; None leaves that of GET."""
    method = connection.method if isinstance(connection, Connection) else b"GET"
    if method == b"GET":
        return None
    if method == b"HEAD":
        return Response(response.status_code, response.reason_phrase, response.headers)
    refused, allowed = HTTPStatus.METHOD_NOT_ALLOWED, Headers({"Allow": "GET, HEAD", "Content-Length": "0"})
    return Response(refused.value, refused.phrase, allowed)


@contextlib.contextmanager
def any_request() -> Iterator[None]:
    """Has a server of WebSockets that starts within the `with` block answer any HTTP request.

    viser, to 1.1.1, has no option for it.
    """
    serve = websockets.asyncio.server.serve
    known = functools.partial(serve, create_connection=Connection, process_response=answer)
    websockets.asyncio.server.serve = known  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]
