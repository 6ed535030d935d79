"""Server process of `jointfit dashboard`; the command passes the settings as JSON."""

from __future__ import annotations

import asyncio
import json
import socket
import sys
from pathlib import Path

from jointfit_daemon.tools.dashboard._certificates import broker_context, page_context
from jointfit_daemon.tools.dashboard._tunnel import broker_fault
from jointfit_daemon.tools.dashboard.addresses import BrokerAddress, ListenAddress
from jointfit_daemon.tools.dashboard.server import DashboardServer
from jointfit_daemon.tools.stop_signals import cancel_on_signal


def main() -> None:
    """Serve on the socket that the command opened, until a stop signal."""
    settings = json.loads(sys.argv[1])
    broker = BrokerAddress(**settings["broker"])
    authority, certificate, key = (
        None if settings[name] is None else Path(settings[name])
        for name in ("ca", "certificate", "key")
    )
    server = DashboardServer(
        broker,
        broker_context(broker, authority),
        base=settings["base"],
        names=tuple(settings["names"]),
        page_context=page_context(certificate, key),
    )
    if settings["set_up"] is not None:
        from jointfit_daemon.tools.dashboard.set_up import set_up_server

        server = set_up_server(server, Path(settings["set_up"]))
    listener = socket.socket(fileno=settings["descriptor"])
    asyncio.run(_serve(server, ListenAddress(**settings["listen"]), listener))


async def _serve(server: DashboardServer, listen: ListenAddress, listener: socket.socket) -> None:
    """Serve until a stop signal; print the URL, and the reason for an unreachable broker."""
    with cancel_on_signal() as stop:
        try:
            async with server.listening(listen, listener) as url:
                print(f"dashboard: {url}  (broker {server.broker.text}; Ctrl-C stops)", flush=True)
                if type(server) is not DashboardServer:
                    print(f"set-up: {url}set-up.html", flush=True)
                if not listen.is_local:
                    print(exposure(encrypted=server.page_context is not None), file=sys.stderr)
                if server.broker.websocket is None:
                    fault = await broker_fault(server.broker, server.context)
                    if fault is not None:
                        print(
                            f"broker {server.broker.text}: {fault}. The page connects as soon as"
                            " the broker answers.",
                            file=sys.stderr,
                        )
                await asyncio.Event().wait()
        except asyncio.CancelledError:
            if stop.number is None:
                raise


def exposure(*, encrypted: bool) -> str:
    """Return the warning that other devices can open the page."""
    text = (
        "Every device that can open this page can also use the broker: protect the broker with"
        " accounts (docs/security.md)."
    )
    if not encrypted:
        text += (
            " Without TLS, everyone on the network can read passwords and messages: set"
            " --certificate and --key."
        )
    return text


if __name__ == "__main__":
    main()
