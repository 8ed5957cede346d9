"""Guard of a page: who may open it.

Every web page that a user has open may connect to a server on this machine, so a page is served to those who know its
token, under its own host's names, and to no script of another page. Who knows the token is trusted.
"""

import asyncio
import dataclasses
import hmac
import http
import logging
import re
import secrets
import socket
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import Any, Final
from urllib.parse import urlsplit

_PORTS: Final = {"http": ":80", "https": ":443"}
_NUMBER: Final = re.compile(r"[0-9]+(\.[0-9]+){3}|[0-9a-f]*:[0-9a-f:.]*")


class Guard:
    """The token of a page, and the rule of who is served.

    host: the address that is served. allowed: further names of hosts, such as a proxy's.
    """

    def __init__(self, host: str, allowed: Collection[str] = ()) -> None:
        self.token = secrets.token_urlsafe(16)
        self._allowed = {name.lower() for name in allowed}
        self._own = {"localhost", host.lower(), socket.gethostname().lower()}

    def refusal(self, path: str, hosts: list[str], origins: list[str]) -> str | None:
        """Say why a request with a path and headers Host and Origin is refused; None if it is served.

        A name that leads here but is not of this host may be another page's, whose scripts would pass for this one's; a
        number cannot be.
        """
        if not hmac.compare_digest(path.lstrip("/").split("/")[0].split("?")[0].encode(), self.token.encode()):
            return "open the address that bodyseg view printed: the token in it is missing or of another page"
        if len(hosts) != 1 or len(origins) > 1:
            return "a request must name one host"
        name = _name(hosts[0])
        if name not in self._own | self._allowed and not _NUMBER.fullmatch(name):
            return f"{name} is not a host of this page: name it by --allow-host"
        for origin in origins:
            scheme, _, place = origin.lower().partition("://")
            same = place.removesuffix(_PORTS.get(scheme, "")) == hosts[0].lower().removesuffix(_PORTS.get(scheme, ""))
            if not place or not (same or _name(place) in self._allowed):
                return f"a page of {origin} may not use this one: name its host by --allow-host"
        return None


def _name(host: str) -> str:
    """The name in a header "name:port", in small letters; "" if there is none."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


@contextmanager
def guarded(guard: Guard) -> Iterator[None]:
    """While the context lasts, servers of WebSockets that are begun serve whom `guard` lets in, and print nothing of
    what goes wrong on a connection. viser has no place for these rules.
    """
    from websockets.asyncio import server
    from websockets.datastructures import Headers
    from websockets.http11 import Request, Response

    log = logging.getLogger("bodyseg.view")
    log.disabled = True
    plain = server.serve

    def serve(*given: Any, process_request: Callable[..., Response | None], **options: Any) -> Any:
        def answer(connection: server.ServerConnection, request: Request) -> Response | None:
            headers = request.headers
            why = guard.refusal(request.path, headers.get_all("Host"), headers.get_all("Origin"))
            if why is None:
                path = request.path.lstrip("/").removeprefix(guard.token) or "/"
                return process_request(connection, dataclasses.replace(request, path=path))
            body = f"{why}\n".encode()
            head = Headers({"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))})
            return Response(http.HTTPStatus.FORBIDDEN.value, "Forbidden", head, body)

        asyncio.get_running_loop().set_exception_handler(lambda loop, context: None)
        return plain(*given, process_request=answer, logger=log, **options)

    vars(server)["serve"] = serve
    try:
        yield
    finally:
        vars(server)["serve"] = plain
