"""Access to the page needs the token and the address. All other requests are refused."""

import http.client
import json
import socket
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from ipsys_log.app.web.app import build_app
from ipsys_log.app.web.server import qr_code, serve_app
from ipsys_log.errors import IpsysError
from tests.playing import WAIT_LIMIT_S
from tests.web.test_measuring_page import Recording

PLACE = {"marker": "0", "distances": {"A": "170", "B": "190"}, "side": "left", "height": "10"}


class Caller:
    """A plain HTTP client with any headers."""

    def __init__(self, url: str) -> None:
        self.parts = urlsplit(url)
        self.token = self.parts.query.removeprefix("token=")

    def ask(
        self, method: str, path: str, body: Any = None, **headers: str
    ) -> tuple[int, str, dict[str, str]]:
        connection = http.client.HTTPConnection(
            str(self.parts.hostname), self.parts.port or 0, timeout=WAIT_LIMIT_S
        )
        try:
            data = body if isinstance(body, bytes) else None if body is None else json.dumps(body).encode()
            connection.request(method, path, data, {k.replace("_", "-"): v for k, v in headers.items()})
            answer = connection.getresponse()
            return answer.status, answer.read().decode("utf-8", "replace"), dict(answer.getheaders())
        finally:
            connection.close()


@pytest.fixture
def scene() -> Recording:
    return Recording()


@pytest.fixture
def here(scene: Recording) -> Iterator[Caller]:
    with serve_app(build_app(scene), port=0) as page:
        yield Caller(page.url)


@pytest.fixture
def shared(scene: Recording) -> Iterator[Caller]:
    with serve_app(build_app(scene), "127.0.0.1", 0) as page:
        yield Caller(page.url)


def test_local_page_has_no_token_and_listens_on_loopback(here: Caller) -> None:
    assert here.token == ""
    assert here.parts.hostname == "127.0.0.1"
    assert here.ask("GET", "/")[0] == 200
    own = socket.gethostbyname(socket.gethostname())
    if not own.startswith("127."):
        with pytest.raises(OSError, match="refused"):
            socket.create_connection((own, here.parts.port or 0), timeout=2)


@pytest.mark.parametrize("path", ["/", "/measure.js", "/api/scene", "/api/views", "/picture/red/1", "/none"])
def test_request_without_the_token_is_refused(shared: Caller, path: str) -> None:
    assert len(shared.token) >= 16
    wrong = shared.token[:-1] + ("A" if shared.token[-1] != "A" else "B")
    cookie = f"ipsys_{shared.parts.port}"
    for attempt in ({}, {"Cookie": f"{cookie}={wrong}"}, {"Cookie": f"{cookie}="}, {"Cookie": "\xff=;;"}):
        status, text, _ = shared.ask("GET", path, **attempt)
        assert status == 403
        assert "the full address that ipsys printed" in text
    assert shared.ask("GET", f"{path}?token={wrong}")[0] == 403


def test_token_becomes_a_protected_cookie(shared: Caller) -> None:
    status, _, headers = shared.ask("GET", f"/?token={shared.token}")
    assert (status, headers["location"]) == (303, "/")
    cookie = headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie
    status, text, headers = shared.ask("GET", "/", Cookie=headers["set-cookie"].split(";")[0])
    assert status == 200
    assert shared.token not in text
    assert "default-src 'self'" in headers["content-security-policy"]


def test_cookies_of_other_programs_do_not_block_access(shared: Caller) -> None:
    name = f"ipsys_{shared.parts.port}"
    ours = f"{name}={shared.token}"
    for header in (
        f'foo={{"a":"b"}}; {ours}',
        f'{ours}; foo={{"a":"b"}}',
        f"{ours};foo=[1,2]",
        f"bare; {ours}; =nameless; ;; =",
        f'foo="open; {ours}',
        f'a b=c d; {name}="{shared.token}"',
        f"{name}=stale; {ours}",
        f"foo=\xff\xfe; {ours}",
        f"$Version=1; foo@bar=1,2; {ours} ",
        f"foo={'x' * 20_000}; {ours}",
    ):
        assert shared.ask("GET", "/api/scene", Cookie=header)[0] == 200, header
    for header in (f"x{ours}", f"{name}x={shared.token}", name, f"{name}=x{shared.token}", f"{ours}x"):
        assert shared.ask("GET", "/api/scene", Cookie=header)[0] == 403, header


def test_foreign_host_name_is_refused(here: Caller, shared: Caller) -> None:
    for caller in (here, shared):
        path = f"/?token={caller.token}"
        for host in (
            "evil.example",
            "evil.example:8000",
            "localhost.evil.example",
            "127.0.0.1.evil.example",
            "",
        ):
            assert caller.ask("GET", path, Host=host)[0] in (400, 403)
        for host in ("localhost", f"localhost:{caller.parts.port}", "[::1]:80", "192.168.7.7"):
            assert caller.ask("GET", path, Host=host)[0] in (200, 303)


def test_requests_of_other_pages_cannot_write(here: Caller, scene: Recording) -> None:
    origin = f"http://127.0.0.1:{here.parts.port}"
    assert here.ask("POST", "/api/measure", PLACE)[0] == 403
    assert here.ask("POST", "/api/measure", PLACE, X_Ipsys="1", Origin="http://evil.example")[0] == 403
    assert here.ask("OPTIONS", "/api/measure", Origin="http://evil.example")[0] == 403
    assert scene.done == []
    status, text, _ = here.ask("POST", "/api/measure", PLACE, X_Ipsys="1", Origin=origin)
    assert (status, json.loads(text)["saved"]) == (200, "p001")
    assert here.ask("GET", "/api/measure")[0] == 405


@pytest.mark.parametrize(
    "body", [b"", b"{", b"[]", b"\xff", {"distances": [1]}, {**PLACE, "marker": "x" * 20_000}, {"id": "p9"}]
)
def test_invalid_entry_is_refused_with_a_text(here: Caller, scene: Recording, body: Any) -> None:
    for path in ("/api/measure", "/api/undo"):
        status, text, _ = here.ask("POST", path, body, X_Ipsys="1")
        assert status in (400, 409)
        assert "error" in text or "faults" in text
    assert scene.done == []


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/api/check", b"[" * 15_000),
        ("/api/check", b'{"stop": ' + b"9" * 5_000 + b"}"),
        ("/api/check", b'{"marker": "\\ud800", "distances": {"\\udc00": "1"}}'),
        ("/api/undo", b'{"id": "\\ud800"}'),
        ("/api/undo", b"\xff\xfe"),
        ("/api/views?marker=" + "9" * 5_000, None),
        ("/api/views?marker=%ED%A0%80", None),
        ("/picture/red/" + "9" * 5_000, None),
    ],
)
def test_request_beyond_all_bounds_gets_no_server_error(
    here: Caller, scene: Recording, path: str, body: bytes | None, capfd: pytest.CaptureFixture[str]
) -> None:
    origin = f"http://{here.parts.netloc}"
    method = "GET" if body is None else "POST"
    status, _, _ = here.ask(method, path, body, X_Ipsys="1", Origin=origin)
    assert status < 500
    assert scene.done == []
    assert "Traceback" not in capfd.readouterr().err


def test_unseen_warning_blocks_saving(here: Caller, scene: Recording) -> None:
    flat = {**PLACE, "distances": {"A": "330", "B": "87"}}
    status, text, _ = here.ask("POST", "/api/measure", flat, X_Ipsys="1")
    assert status == 409, text
    warnings = json.loads(text)["warnings"]
    assert warnings
    assert scene.done == []
    assert here.ask("POST", "/api/measure", {**flat, "accepted": warnings}, X_Ipsys="1")[0] == 200
    assert len(scene.done) == 1


def test_a_port_that_is_in_use_and_a_host_that_is_not_ours(here: Caller, scene: Recording) -> None:
    with (
        pytest.raises(IpsysError, match=f"--port {here.parts.port}: is in use"),
        serve_app(build_app(scene), port=here.parts.port or 0),
    ):
        pass
    with (
        pytest.raises(IpsysError, match=r"not an address of this machine|cannot listen on"),
        serve_app(build_app(scene), "192.0.2.7", 0),
    ):
        pass


def test_the_code_for_the_phone_is_read_by_a_reader() -> None:
    url = "http://192.168.100.200:8000/?token=abcdefghijklmnop"
    lines = qr_code(url).splitlines()
    light = {"█": (1, 1), "▄": (0, 1), "▀": (1, 0), " ": (0, 0)}
    rows = [[light[c][half] for c in line] for line in lines for half in (0, 1)]
    picture = cv2.resize(np.array(rows, np.uint8) * 255, None, fx=8, fy=8, interpolation=cv2.INTER_NEAREST)
    picture = cv2.copyMakeBorder(picture, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255)
    assert cv2.QRCodeDetector().detectAndDecode(picture)[0] == url
