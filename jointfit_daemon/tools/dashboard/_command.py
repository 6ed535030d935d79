"""Command `jointfit dashboard`: serves the web page of a rig."""

from __future__ import annotations

import asyncio
from pathlib import Path  # noqa: TC003 - typer reads annotations at run time
from typing import TYPE_CHECKING, Annotated

import typer

from jointfit_daemon.tools.dashboard.addresses import LISTEN, parse_broker, parse_listen
from jointfit_daemon.tools.stop_signals import cancel_on_signal

if TYPE_CHECKING:
    from jointfit_daemon.tools.dashboard.addresses import ListenAddress
    from jointfit_daemon.tools.dashboard.server import DashboardServer


def dashboard(
    *,
    listen: Annotated[
        str, typer.Option(help="Address of the page, HOST:PORT; 0.0.0.0:8080 for other devices.")
    ] = LISTEN,
    broker: Annotated[
        str,
        typer.Option(help="mqtt://HOST:PORT, mqtts://HOST:PORT with TLS, or wss://HOST/PATH."),
    ] = "mqtt://localhost:1883",
    base: Annotated[
        str | None, typer.Option(help="Base topic of the rig. Default: the page finds it.")
    ] = None,
    ca: Annotated[
        Path | None, typer.Option(help="Certificate of the broker's authority, for mqtts://.")
    ] = None,
    name: Annotated[
        list[str] | None,
        typer.Option(help="Host name under which browsers open the page; repeatable."),
    ] = None,
) -> None:
    """Serve the dashboard: a web page with limb, joint angles, sensors and calibration.

    The page connects to the broker through this server. User name and password of the broker are
    entered in the page and are not stored. Ctrl-C or SIGTERM stops the server.
    """
    address, target = parse_listen(listen), parse_broker(broker)

    from jointfit_daemon.tools.dashboard._tunnel import tls_context
    from jointfit_daemon.tools.dashboard.server import DashboardServer

    server = DashboardServer(
        target,
        tls_context(target, ca),
        base=base.strip("/") if base else None,
        names=tuple(each.lower() for each in name or ()),
    )
    asyncio.run(_serve(server, address))


async def _serve(server: DashboardServer, listen: ListenAddress) -> None:
    """Serve until a stop signal; print the URL, and a broker that cannot be reached."""
    from jointfit_daemon.tools.dashboard._tunnel import broker_fault

    with cancel_on_signal() as stop:
        try:
            async with server.listening(listen) as url:
                typer.echo(f"dashboard: {url}  (broker {server.broker.text}; Ctrl-C stops)")
                if not listen.is_local:
                    typer.echo(
                        "Every device that can open this page can also use the broker: protect the"
                        " broker with accounts (docs/security.md).",
                        err=True,
                    )
                if server.broker.websocket is None:
                    fault = await broker_fault(server.broker, server.context)
                    if fault is not None:
                        typer.echo(
                            f"broker {server.broker.text}: {fault}. The page connects as soon as"
                            " it answers.",
                            err=True,
                        )
                await asyncio.Event().wait()
        except asyncio.CancelledError:
            if stop.number is None:
                raise
