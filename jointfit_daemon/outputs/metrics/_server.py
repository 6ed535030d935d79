"""HTTP server of the metrics, with one thread that requests a snapshot from the event loop.

Invariant: a client that sends or reads nothing delays requests of other clients by at most
`_CLIENT_S`. It does not delay the event loop.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
from typing import TYPE_CHECKING, Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from typing_extensions import override  # typing contains it from Python 3.12

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from jointfit_daemon.config import MetricsSettings
    from jointfit_daemon.outputs.metrics._frame_statistics import FrameStatistics
    from jointfit_daemon.outputs.payloads import BridgeHealth

_CLIENT_S = 2.0
"""Longest wait for a client or for a snapshot, s."""
_POLL_S = 0.1
"""Interval at which the thread checks whether it must end, s."""


class MetricsError(Exception):
    """The metrics cannot be served; the message states the remedy."""


class MetricsServer:
    """Answers ``GET /metrics``.

    Parameters
    ----------
    settings
        Table ``[metrics]``, which contains the address.
    rig
        Name of the rig.
    health
        Function that returns the health of this instant; called on the event loop.
    frames
        Latency histogram, shared with the event loop.
    """

    def __init__(
        self,
        settings: MetricsSettings,
        rig: str,
        health: Callable[[], BridgeHealth],
        frames: FrameStatistics,
    ) -> None:
        self._settings, self._rig, self._health, self._frames = settings, rig, health, frames
        self._server: WSGIServer | None = None

    @property
    def url(self) -> str:
        """Address of the metrics, including the port in use."""
        host = self._settings.host
        shown = f"[{host}]" if ":" in host else host
        port = self._settings.port if self._server is None else self._server.server_port
        return f"http://{shown}:{port}/metrics"

    def start(self) -> None:
        """Start a thread that listens on the address and answers requests.

        Raises
        ------
        MetricsError
            ``prometheus_client`` is not installed, or the address is not available.
        """
        try:
            from prometheus_client import (  # noqa: PLC0415 - optional package
                CollectorRegistry,
                make_wsgi_app,
            )
        except ImportError as error:
            text = "needs the package prometheus-client: pip install 'jointfitd[metrics]'"
            raise MetricsError(text) from error

        registry = CollectorRegistry(auto_describe=False)
        registry.register(_Snapshot(self._take))
        app = _only_metrics(make_wsgi_app(registry))
        self._loop = asyncio.get_running_loop()
        host, port = self._settings.host, self._settings.port
        try:
            self._server = make_server(host, port, app, _server_of(host), _Handler)
        except OSError as error:
            raise MetricsError(
                f"cannot listen on {self._settings.listen}: {error.strerror or error}; set another "
                "[metrics] listen, or stop the program that uses this port"
            ) from error
        serve = self._server.serve_forever
        threading.Thread(target=serve, args=(_POLL_S,), name="metrics", daemon=True).start()

    async def run(self) -> None:
        """Serve until cancelled."""
        server = self._server
        if server is None:
            return
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.to_thread(server.shutdown)
            server.server_close()

    def _take(self) -> Iterator[Any]:
        """Return the metrics of this instant. The thread of the server calls this method."""
        from jointfit_daemon.outputs.metrics._families import (  # noqa: PLC0415 - optional package
            metric_families,
        )

        async def snapshot() -> BridgeHealth:
            return self._health()

        future = asyncio.run_coroutine_threadsafe(snapshot(), self._loop)
        return metric_families(self._rig, future.result(_CLIENT_S), self._frames)


class _Snapshot:
    """A collector of ``prometheus_client`` that returns one snapshot."""

    def __init__(self, take: Callable[[], Iterator[Any]]) -> None:
        self.collect = take


class _Handler(WSGIRequestHandler):
    """HTTP handler that writes no log line for a request."""

    @override
    def log_message(self, format: str, *args: Any) -> None:
        """Do nothing, so that a request writes no log line."""


def _server_of(host: str) -> type[WSGIServer]:
    class Server(WSGIServer):
        address_family = socket.AF_INET6 if ":" in host else socket.AF_INET

        @override
        def finish_request(self, request: Any, client_address: Any) -> None:
            """Answer one client, and end its connection at the time limit."""
            # A timeout of the socket would not end a client that sends or reads single bytes.
            limit = threading.Timer(_CLIENT_S, _end, (request,))
            limit.daemon = True
            limit.start()
            try:
                super().finish_request(request, client_address)
            finally:
                limit.cancel()

        @override
        def handle_error(self, request: Any, client_address: Any) -> None:
            """Ignore a client that disconnected or was too slow."""

    return Server


def _end(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


def _only_metrics(app: Any) -> Any:
    """Return an application that serves ``/metrics`` and refuses all other paths."""

    def serve(environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        if environ.get("PATH_INFO") != "/metrics":
            start_response("404 Not Found", [("Content-Type", "text/plain; charset=utf-8")])
            return [b"The metrics are at /metrics.\n"]
        found: Iterable[bytes] = app(environ, start_response)
        return found

    return serve
