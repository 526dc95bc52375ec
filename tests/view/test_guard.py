"""Who may connect: this machine's programs and the page itself, no other web page."""

import socket
import urllib.error
import urllib.request

import pytest
import viser
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.http11 import Request
from websockets.sync.client import connect

from rfsg.scene.scene import Scene
from rfsg.view import guard
from rfsg.view.page import HOST, Page
from rfsg.view.session import Session
from tests.scenes import box_node, radio


@pytest.fixture(scope="module")
def port():
    nodes = (box_node("/World/Box", (0.0, 1.2, 0.5), (0.4, 0.3, 0.5)),)
    scene = Scene(nodes, (radio("/tx", -2.0, 0.0, 0.8),), (radio("/rx", 2.5, 0.2, 0.9),), 2.4e9)
    session = Session(scene, quality="draft")
    page = Page(session, port=0)
    yield page.server.get_port()
    page.close()
    session.close()


def greeted(port: int, host: str, origin: str | None) -> int:
    """The status of a handshake as a browser makes it that reached this port by a name."""
    name = f"{host}:{port}"
    protocol = f"viser-v{viser.__version__}"
    with socket.create_connection((HOST, port)) as raw:
        options = {"sock": raw, "subprotocols": [protocol], "proxy": None, "open_timeout": 60.0}
        try:
            with connect(f"ws://{name}", origin=origin, **options) as socket_:
                assert socket_.recv(timeout=60.0)  # the scene itself
                return 101
        except InvalidStatus as error:
            return error.response.status_code


def test_the_page_itself_and_programs_may_connect(port):
    assert greeted(port, "127.0.0.1", f"http://127.0.0.1:{port}") == 101
    assert greeted(port, "localhost", f"http://localhost:{port}") == 101
    assert greeted(port, "127.0.0.1", None) == 101


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("127.0.0.1", "https://example.org"),
        ("127.0.0.1", "http://127.0.0.1:1"),  # another server of this machine
        ("127.0.0.1", "null"),  # a file, or a frame without rights
        ("rebound.example.org", "http://rebound.example.org:{port}"),
        ("rebound.example.org", None),
    ],
)
def test_other_web_pages_may_not(port, host, origin):
    assert greeted(port, host, origin and origin.format(port=port)) == 403


def test_a_name_that_is_not_this_machines_gets_no_page(port):
    url = f"http://{HOST}:{port}/"
    with urllib.request.urlopen(url, timeout=60.0) as answer:
        assert answer.status == 200
    stranger = urllib.request.Request(url, headers={"Host": f"rebound.example.org:{port}"})
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(stranger, timeout=60.0)


@pytest.mark.parametrize(
    ("headers", "refused"),
    [
        ([("Host", "127.0.0.1:8080")], False),
        ([("Host", "[::1]:8080"), ("Origin", "http://[::1]:8080")], False),
        ([("Host", "localhost:9000"), ("Origin", "http://localhost:9000")], False),  # forwarded
        ([], True),
        ([("Host", "127.0.0.1:8080"), ("Host", "example.org")], True),
        ([("Host", "127.0.0.1.example.org:8080")], True),
        ([("Host", "[127.0.0.1:8080")], True),
        ([("Host", "127.0.0.1:80"), ("Origin", "http://127.0.0.1:80"), ("Origin", "x")], True),
        ([("Host", "127.0.0.1:80"), ("Origin", "http://127.0.0.1:80@example.org")], True),
    ],
)
def test_headers_that_are_refused(headers, refused):
    assert (guard.refusal(Request("/", Headers(headers))) is not None) == refused


def test_no_page_rather_than_one_without_a_guard(monkeypatch):
    """A viser that serves by something else is stopped."""
    stopped = []

    class Other:
        def stop(self):
            stopped.append(True)

    with pytest.raises(RuntimeError, match="guard"):
        guard.guarded(Other)
    assert stopped and guard.server.serve.__name__ == "serve"
