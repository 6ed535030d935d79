"""The dashboard's web server answers every HTTP request, even malformed requests, as specified."""

from __future__ import annotations

import asyncio
import gzip
import json
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from websockets.datastructures import Headers
from websockets.http11 import Request

from jointfit_daemon.tools.dashboard._page_files import read_page_files
from jointfit_daemon.tools.dashboard.addresses import BrokerAddress, ListenAddress
from jointfit_daemon.tools.dashboard.server import DashboardServer
from tests.broker_fixture import HOST

if TYPE_CHECKING:
    from websockets.http11 import Response

FILES = read_page_files()
SERVER = DashboardServer(BrokerAddress(HOST, 1), files=FILES)
LISTEN = ListenAddress(HOST, 0)
FORBIDDEN = {500, 501, 502}
CONFIGURED = {"version", "broker", "websocket", "base"}
CONTENTS = {found.content for found in FILES.values()}


def respond(
    target: str = "/", method: str = "GET", headers: list[tuple[str, str]] | None = None
) -> Response:
    """Return the response to a request that opens no tunnel to the broker."""
    request = Request(target, Headers([("Host", "localhost"), *(headers or [])]), method)
    response = SERVER.respond(None, request)  # type: ignore[arg-type]  # not used
    assert response is not None
    return response


async def sent(request: bytes, *, end: bool = False) -> bytes:
    """Send `request` to a server; return all bytes of the answer.

    With `end`, the client closes its sending side after the request.
    """
    async with SERVER.listening(LISTEN) as url, asyncio.timeout(5):
        port = int(url.rstrip("/").rpartition(":")[2])
        reader, writer = await asyncio.open_connection(HOST, port)
        writer.write(request)
        if end:
            writer.write_eof()
        answer = await reader.read()
        writer.close()
        return answer


@pytest.mark.parametrize("path", ["/", "/js/main.js", "/config.json", "/no-such-page", "/mqtt"])
def test_head_returns_the_headers_of_get_without_its_content(path: str) -> None:
    get, head = respond(path), respond(path, "HEAD")
    assert head.body == b""
    assert (head.status_code, list(head.headers.raw_items())) == (
        get.status_code, list(get.headers.raw_items()),
    )  # fmt: skip


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "TRACE", "PROPFIND", "get"])
async def test_other_methods_are_refused_with_those_that_work(method: str) -> None:
    answer = await sent(f"{method} / HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
    assert answer.startswith(b"HTTP/1.1 405 ")
    assert b"Allow: GET, HEAD" in answer


@pytest.mark.parametrize(
    ("known", "status"),
    [("{}", 304), ('"x", {}', 304), ("*", 304), ("strong {}", 304), ('"x"', 200), ("", 200)],
)
def test_a_file_is_sent_again_only_if_its_tag_is_unknown(known: str, status: int) -> None:
    etag = FILES["/"].etag
    known = known.removeprefix("strong ").format(
        etag.removeprefix("W/") if "strong" in known else etag
    )
    response = respond("/", headers=[("If-None-Match", known)])
    assert response.status_code == status
    assert (response.body == b"") == (status == 304)


@pytest.mark.parametrize(
    "value", ["bytes=0-10", "bytes=-1", "bytes=5-1", "lines=1", "bytes=0-1,3-"]
)
def test_a_range_is_ignored_and_the_whole_file_sent(value: str) -> None:
    response = respond("/", headers=[("Range", value)])
    assert (response.status_code, response.body) == (200, FILES["/"].content)


@pytest.mark.parametrize(
    ("accepted", "compressed"),
    [("gzip", True), ("br, GZIP;q=0.5", True), ("gzip; q=0", False), ("xgzip", False), ("", False)],
)
def test_content_is_compressed_where_the_browser_accepts_it(
    accepted: str, compressed: bool
) -> None:
    response = respond("/", headers=[("Accept-Encoding", accepted)])
    assert (response.headers.get("Content-Encoding") == "gzip") == compressed
    body = gzip.decompress(response.body) if compressed else response.body
    assert body == FILES["/"].content


@pytest.mark.parametrize(
    "headers",
    [[("Host", "localhost")], [("Host", "attacker.example")]],
    ids=["the same", "another"],
)
def test_two_host_headers_are_refused(headers: list[tuple[str, str]]) -> None:
    assert respond("/", headers=headers).status_code == 400


@pytest.mark.parametrize("target", ["//[", "http://[/", "*?", "?x", "#"])
async def test_a_malformed_target_is_refused(target: str) -> None:
    answer = await sent(f"GET {target} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
    assert answer.startswith((b"HTTP/1.1 400 ", b"HTTP/1.1 404 "))


WORDS = (
    "..", ".", "%2e%2e", "%2f", "%00", "\\", "~", "", "js", "main.js", "server.py", "etc", "passwd",
    "index.html", "mqtt", "config.json",
)  # fmt: skip
NAMES = ("If-None-Match", "Accept-Encoding", "Range", "Origin", "Upgrade", "Host")


@given(
    st.one_of(
        st.text(st.characters(codec="ascii"), max_size=60),
        st.lists(st.sampled_from(WORDS), max_size=8).map("/".join),
    ),
    st.sampled_from(["GET", "HEAD", "POST", "PUT"]),
    st.lists(
        st.tuples(
            st.sampled_from(NAMES),
            st.text(st.characters(codec="ascii", min_codepoint=32, max_codepoint=126), max_size=40),
        ),
        max_size=4,
    ),
)
@settings(max_examples=300, deadline=None)
def test_no_request_fails_or_returns_anything_but_the_page(
    target: str, method: str, headers: list[tuple[str, str]]
) -> None:
    response = respond(target, method, headers)
    assert response.status_code not in FORBIDDEN
    assert "default-src 'none'" in response.headers["Content-Security-Policy"]
    if response.status_code == 200 and response.body:
        encoded = response.headers.get("Content-Encoding") == "gzip"
        body = gzip.decompress(response.body) if encoded else bytes(response.body)
        assert body in CONTENTS or set(json.loads(body)) == CONFIGURED


@given(st.binary(max_size=300), st.booleans())
@settings(max_examples=40, deadline=None)
def test_bytes_that_are_no_request_end_in_a_closed_connection(noise: bytes, after: bool) -> None:
    """The server neither answers with a status of `FORBIDDEN` nor leaves the connection open.

    If the connection remained open, `sent` would raise `TimeoutError`.
    """
    request = b"GET / HTTP/1.1\r\nHost: localhost\r\n" + noise + b"\r\n\r\n" if after else noise
    answer = asyncio.run(sent(request, end=True))
    assert not answer.startswith(tuple(f"HTTP/1.1 {code}".encode() for code in FORBIDDEN))


@pytest.mark.parametrize(
    ("request_bytes", "status"),
    [
        (b"GET /" + b"a" * 9000 + b" HTTP/1.1\r\nHost: localhost\r\n\r\n", b"414"),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"a" * 9000 + b"\r\n\r\n", b"431"),
        (b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 200 + b"\r\n", b"431"),
    ],
    ids=["target", "header", "headers"],
)
async def test_a_request_has_a_size_limit(request_bytes: bytes, status: bytes) -> None:
    answer = await sent(request_bytes)
    assert answer == b"" or answer.startswith(b"HTTP/1.1 " + status)
