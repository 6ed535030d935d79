"""Command `jointfit dashboard`: serves the web page of a rig."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from jointfit_daemon.tools.dashboard.addresses import (
    LISTEN,
    ListenAddress,
    parse_broker,
    parse_listen,
)

_Ca = Annotated[
    Path | None,
    typer.Option(
        help="Certificate of the authority that signed the broker's certificate (mqtts://)."
    ),
]


def dashboard(
    *,
    listen: Annotated[
        str, typer.Option(help="Address of the page, HOST:PORT. Other devices need 0.0.0.0:8080.")
    ] = LISTEN,
    broker: Annotated[
        str,
        typer.Option(help="Broker: mqtt://HOST:PORT, mqtts://HOST:PORT (TLS) or wss://HOST/PATH."),
    ] = "mqtt://localhost:1883",
    base: Annotated[
        str | None, typer.Option(help="Base topic of the rig. Default: the page finds it.")
    ] = None,
    ca: _Ca = None,
    certificate: Annotated[
        Path | None, typer.Option(help="Certificate of this machine. It turns on HTTPS.")
    ] = None,
    key: Annotated[
        Path | None, typer.Option(help="Private key of --certificate, if it is in another file.")
    ] = None,
    name: Annotated[
        list[str] | None,
        typer.Option(help="Host name under which browsers open the page; repeatable."),
    ] = None,
    set_up: Annotated[
        Path | None,
        typer.Option("--set-up", help="Folder for a new rig.toml. The page asks for its content."),
    ] = None,
) -> None:
    """Serve the dashboard: a web page with limb, joint angles, sensors and calibration.

    The page connects to the broker through this server. User name and password of the broker are
    entered in the page and are not stored. Ctrl-C or SIGTERM stops the server.
    """
    address, target = parse_listen(listen), parse_broker(broker)

    from jointfit_daemon.tools.dashboard._certificates import broker_context, page_context
    from jointfit_daemon.tools.dashboard.server import open_listener

    broker_context(target, ca), page_context(certificate, key)  # reports invalid files
    rig = None if set_up is None else _new_rig(set_up, address)
    listener = open_listener(address)
    listener.set_inheritable(True)
    settings = {
        "descriptor": listener.fileno(),
        "listen": asdict(address),
        "broker": asdict(target),
        "ca": None if ca is None else str(ca),
        "certificate": None if certificate is None else str(certificate),
        "key": None if key is None else str(key),
        "base": base.strip("/") if base else None,
        "names": [each.lower() for each in name or ()],
        "set_up": None if rig is None else str(rig),
    }
    # The server can run for days, so it runs without the command-line libraries. They would need a
    # third of its memory.
    module = "jointfit_daemon.tools.dashboard"
    os.execv(sys.executable, [sys.executable, "-m", module, json.dumps(settings)])  # noqa: S606 - itself


def _new_rig(folder: Path, address: ListenAddress) -> Path:
    """Return the path of the rig that the page writes; refuse access from other machines."""
    from jointfit_daemon.tools.init import rig_path

    if not address.is_local:
        raise ValueError(
            "--set-up writes files and opens devices: use it with --listen 127.0.0.1:8080. If this"
            " machine has no screen, open the page through ssh -L 8080:127.0.0.1:8080"
        )
    return rig_path(folder).absolute()
