"""Web server of the dashboard: page files, page configuration, and the tunnel to the broker.

Invariants: every response forbids scripts and styles from other origins, and connections to other
origins except the WebSocket of the configured broker. Pages of other origins cannot use the tunnel.
"""

from __future__ import annotations

import contextlib
import gc
import ipaddress
import json
import logging
import socket
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from jointfit_daemon import __version__
from jointfit_daemon.tools.dashboard._page_files import PageFile, read_page_files
from jointfit_daemon.tools.dashboard._tunnel import tunnel
from jointfit_daemon.tools.dashboard.addresses import bracket_ipv6

if TYPE_CHECKING:
    import ssl
    from collections.abc import AsyncIterator

    from jointfit_daemon.tools.dashboard.addresses import BrokerAddress, ListenAddress

TUNNEL = "/mqtt"
"""URL path of the tunnel."""
_METHODS = ("GET", "HEAD")
MOST_VIEWERS = 64
"""Maximum number of open tunnels."""
_PACKET_BYTES = 64 * 1024
"""Maximum size of a WebSocket message from a page, bytes. A request has at most 32 KiB."""
_PING_S = 20.0
"""Time between two WebSocket pings, s. The connection of a lost page is closed after at most two
intervals."""


@dataclass(slots=True)
class DashboardServer:
    """Serves the page and connects it to a broker."""

    broker: BrokerAddress
    context: ssl.SSLContext | None = None
    base: str | None = None
    """Base topic of the rig that the page shows; None if the page searches for rigs."""
    names: tuple[str, ...] = ()
    """Additional host names that browsers may use to open the page."""
    page_context: ssl.SSLContext | None = None
    """TLS context with certificate and key of this machine for HTTPS; None for HTTP."""
    files: dict[str, PageFile] = field(default_factory=read_page_files)
    _viewers: int = 0

    @contextlib.asynccontextmanager
    async def listening(
        self, listen: ListenAddress, listener: socket.socket | None = None
    ) -> AsyncIterator[str]:
        """Serve the page during the ``with`` block; yield the URL of the page.

        Parameters
        ----------
        listen
            Address of the page.
        listener
            Socket that listens on the address; the default is a new socket.

        Raises
        ------
        ValueError
            The errors of `open_listener`.
        """
        # At lower levels, the library would log every malformed request with a traceback.
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
        async with serve(
            self._serve_viewer,
            sock=open_listener(listen) if listener is None else listener,
            ssl=self.page_context,
            process_request=self.respond,
            subprotocols=[Subprotocol("mqtt"), Subprotocol("jointfit-set-up")],
            server_header=None,
            compression=None,  # compression saves no time on a local network
            max_size=_PACKET_BYTES,
            ping_interval=_PING_S,
            ping_timeout=_PING_S,
        ) as server:
            gc.freeze()
            yield _url(listen, server, "http" if self.page_context is None else "https")

    async def _serve_viewer(self, websocket: ServerConnection) -> None:
        self._viewers += 1
        try:
            await tunnel(websocket, self.broker, self.context)
        finally:
            self._viewers -= 1

    def respond(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the response to a request; None to open the tunnel."""
        del connection
        method = getattr(request, "method", "GET")  # old versions of websockets accept GET only
        response = self._refusal(request, method) or self._answer(request, method)
        if method == "HEAD" and response is not None:
            response.body = b""  # the headers are the same as in the response to GET
        return response

    def _refusal(self, request: Request, method: str) -> Response | None:
        """Return the error response to an invalid request; None for a valid request."""
        host = request.headers.get_all("Host")
        if _path(request.path) is None or len(host) != 1:
            return self._text(HTTPStatus.BAD_REQUEST, "Expected a path and one Host header.")
        if not self._is_own_name(host[0]):
            return self._text(
                HTTPStatus.MISDIRECTED_REQUEST,
                f"The dashboard does not answer to the name {host[0][:80]!r}."
                " Open it by its IP address, or start the dashboard with --name.",
            )
        if method not in _METHODS:
            refusal = self._text(HTTPStatus.METHOD_NOT_ALLOWED, "The page can only be read.")
            refusal.headers["Allow"] = ", ".join(_METHODS)
            return refusal
        return None

    def _answer(self, request: Request, method: str) -> Response | None:
        path = _path(request.path)
        if path == TUNNEL:
            return self._check_tunnel(request, method)
        if path == "/config.json":
            return self._response(HTTPStatus.OK, "application/json", self._configuration())
        found = self.files.get(path or "")
        if found is None:
            return self._text(HTTPStatus.NOT_FOUND, "There is no such page. The dashboard is at /.")
        return self._file(found, request.headers)

    def _check_tunnel(self, request: Request, method: str) -> Response | None:
        """Return an error response if the tunnel is refused; None if it may open."""
        if method != "GET" or "websocket" not in _tokens(request.headers, "Upgrade"):
            return self._text(HTTPStatus.UPGRADE_REQUIRED, "This path is for WebSockets only.")
        # Programs send no Origin header. Browsers always send it, and a page cannot change it.
        origins, host = request.headers.get_all("Origin"), request.headers["Host"].lower()
        if any(_authority(origin) != host for origin in origins):
            return self._text(HTTPStatus.FORBIDDEN, "Pages of other origins cannot use the tunnel.")
        if self._viewers >= MOST_VIEWERS:
            return self._text(
                HTTPStatus.SERVICE_UNAVAILABLE, f"{MOST_VIEWERS} pages are open: close some."
            )
        return None

    def _is_own_name(self, host: str) -> bool:
        """Return whether a Host header names this server.

        If the name of another site resolves to this machine (DNS rebinding), a browser would treat
        pages of that site as pages of this server.
        """
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        machine = socket.gethostname().lower()
        if name in ("localhost", machine, f"{machine}.local", *self.names):
            return True
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True

    def _configuration(self) -> bytes:
        """Return the settings that the page requests when it starts."""
        return json.dumps(
            {
                "version": __version__,
                "broker": self.broker.text,
                "websocket": self.broker.websocket,
                "base": self.base,
            }
        ).encode()

    def _file(self, found: PageFile, headers: Headers) -> Response:
        more = {"ETag": found.etag, "Vary": "Accept-Encoding"}
        # The server sends whole files only. It ignores a Range header, as RFC 9110 permits.
        known = _tokens(headers, "If-None-Match")
        if "*" in known or found.etag.lower().removeprefix("w/") in {
            tag.removeprefix("w/") for tag in known
        }:
            return self._response(HTTPStatus.NOT_MODIFIED, found.content_type, b"", more)
        if "gzip" in _tokens(headers, "Accept-Encoding"):
            more["Content-Encoding"] = "gzip"
            return self._response(HTTPStatus.OK, found.content_type, found.compressed, more)
        return self._response(HTTPStatus.OK, found.content_type, found.content, more)

    def _text(self, status: HTTPStatus, text: str) -> Response:
        return self._response(status, "text/plain; charset=utf-8", f"{text}\n".encode())

    def _response(
        self, status: HTTPStatus, kind: str, body: bytes, more: dict[str, str] | None = None
    ) -> Response:
        headers = Headers(
            {
                "Content-Type": kind,
                "Content-Length": str(len(body)),
                "Connection": "close",
                "Cache-Control": "no-cache",  # browsers check stored files by their ETag
                "Content-Security-Policy": self.security_policy,
                "X-Content-Type-Options": "nosniff",
                "Referrer-Policy": "no-referrer",
                "Cross-Origin-Opener-Policy": "same-origin",
                "Cross-Origin-Resource-Policy": "same-origin",
            }
            | (more or {})
        )
        return Response(status.value, status.phrase, headers, body)

    @property
    def security_policy(self) -> str:
        """Return the Content-Security-Policy: this origin only, no inline script or style."""
        connect = "'self'"
        if self.broker.websocket is not None:
            parts = urlsplit(self.broker.websocket)
            connect += f" {parts.scheme}://{parts.netloc}"
        return (
            "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self';"
            f" manifest-src 'self'; connect-src {connect};"
            " base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )


def _path(target: str) -> str | None:
    """Return the path of a request target; None if the target has no path."""
    try:
        return urlsplit(target).path or None
    except ValueError:
        return None


def _authority(origin: str) -> str | None:
    """Return host and port of an Origin header; None if the header is not a URL."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return None


def _tokens(headers: Headers, name: str) -> set[str]:
    """Return, in lower case, the elements of all headers `name`, without elements with ``q=0``."""
    elements = ",".join(headers.get_all(name)).lower().split(",")
    parts = [element.replace(" ", "").split(";") for element in elements]
    return {token for token, *weight in parts if weight not in (["q=0"], ["q=0.0"], ["q=0.000"])}


def open_listener(listen: ListenAddress) -> socket.socket:
    """Return a socket that listens on the first address of a host name.

    Raises
    ------
    ValueError
        The address is in use, or does not belong to this machine.
    """
    try:
        found = socket.getaddrinfo(listen.host, listen.port, type=socket.SOCK_STREAM)
        family, _, _, _, address = found[0]
        return socket.create_server(address[:2], family=family, backlog=128)
    except OSError as error:
        raise ValueError(
            f"--listen {bracket_ipv6(listen.host)}:{listen.port}: {error.strerror}:"
            " choose another address or port"
        ) from error


def _url(listen: ListenAddress, server: Server, scheme: str) -> str:
    """Return the URL under which a browser opens the page."""
    host, port = next(iter(server.sockets)).getsockname()[:2]
    if ipaddress.ip_address(host).is_unspecified:
        host = own_address()
    elif listen.host == "localhost":
        host = "localhost"
    return f"{scheme}://{bracket_ipv6(host)}:{port}/"


def own_address() -> str:
    """Return the network address of this machine; without a network, the loopback address.

    No packet is sent, because connecting a UDP socket only selects the interface of the default
    route.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address reserved for documentation (RFC 5737)
        except OSError:
            return "127.0.0.1"
        return str(probe.getsockname()[0])
