"""Who may connect to the page: programs of this machine, and the page itself in a browser.

A server on 127.0.0.1 is open to every web page in a browser on that machine, for browsers let any page
open a websocket anywhere; and a name that a stranger points to 127.0.0.1 is an address of its own to a
browser (DNS rebinding). Both show in the headers of the handshake, which a page cannot forge: viser
looks at neither, so the handshake is looked at here before viser sees it.
"""

import http
import threading
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server as server
from websockets.http11 import Request

HERE = ("127.0.0.1", "localhost", "::1")  # any port: one may be forwarded, as by ssh
_one_at_a_time = threading.Lock()


def refusal(request: Request) -> str | None:
    """Why a request is refused, None if it is not: it must be for this machine by name, and come from a
    page of the same host and port, or from no page at all."""
    hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
    if len(hosts) != 1 or _name(hosts[0]) not in HERE:
        return "the page is served to this machine alone: open it as 127.0.0.1"
    if origins and origins != [f"http://{hosts[0]}"]:
        return "another page may not connect to this one"
    return None


def guarded(make: Callable[[], viser.ViserServer]) -> viser.ViserServer:
    """The server that ``make`` starts, which answers 403 to what ``refusal`` refuses.

    viser has no place to hand a check to, so the function that it serves by stands aside meanwhile.
    Raises RuntimeError if it did not serve by that: rather no page than one without the check."""
    serve = server.serve
    used = []

    def guarded_serve(*args: Any, process_request: Any = None, **options: Any) -> Any:
        def first(connection: server.ServerConnection, request: Request) -> Any:
            why = refusal(request)
            if why is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{why}\n")
            return process_request(connection, request) if process_request else None

        used.append(True)
        return serve(*args, process_request=first, **options)

    with _one_at_a_time:
        server.serve = guarded_serve
        try:
            made = make()  # returns when it serves
        finally:
            server.serve = serve
    if not used:
        made.stop()
        raise RuntimeError("this version of viser serves in another way: the page has no guard")
    return made


def _name(host: str) -> str | None:
    """The name in host:port; None for what is neither."""
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None
