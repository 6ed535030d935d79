"""Command `jointfit monitor`: limb, angles, sensors and calibration of a rig in a terminal."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jointfit_daemon.tools.dashboard.addresses import parse_broker

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.config import MqttSettings
    from jointfit_daemon.tools.monitor._app import MonitorApp

_DEFAULT_RIG = Path("rig.toml")
_DEFAULT_BROKER = "mqtt://localhost:1883"
_STOP_SIGNALS = (signal.SIGTERM, signal.SIGHUP)
_SIMPLE_TERMINALS = ("linux", "vt100", "vt102", "vt220", "dumb")
"""Types of terminals whose fonts lack Braille patterns, such as the Linux console."""


class MonitorUnavailableError(ImportError):
    """Textual is not installed."""

    def __init__(self) -> None:
        super().__init__("the monitor needs textual: pip install 'jointfitd[monitor]'")


_Rig = Annotated[
    Path | None,
    typer.Option(
        help="rig.toml with the broker, its account and the request key. Default: rig.toml of the"
        " current folder, if it exists and no broker option is given."
    ),
]
_Broker = Annotated[
    str | None,
    typer.Option(
        help="Broker: mqtt://HOST:PORT, or mqtts://HOST:PORT (TLS). Default: mqtt://localhost:1883."
    ),
]
_Base = Annotated[
    str | None, typer.Option(help="Base topic of the rig. Default: the monitor finds it.")
]
_Ca = Annotated[
    Path | None,
    typer.Option(
        help="Certificate of the authority that signed the broker's certificate (mqtts://)."
    ),
]
_User = Annotated[str | None, typer.Option(help="User name for the broker.")]
_PasswordFile = Annotated[Path | None, typer.Option(help="File with the password of --user.")]
_KeyFile = Annotated[Path | None, typer.Option(help="File with the key that signs requests.")]
_Rate = Annotated[float, typer.Option(help="Screen updates per second.", min=0.5, max=10.0)]
_Ascii = Annotated[bool, typer.Option("--ascii", help="Use ASCII characters only.")]


def monitor(
    *,
    rig: _Rig = None,
    broker: _Broker = None,
    base: _Base = None,
    ca: _Ca = None,
    user: _User = None,
    password_file: _PasswordFile = None,
    request_key_file: _KeyFile = None,
    rate: _Rate = 5.0,
    ascii_only: _Ascii = False,
) -> None:
    """Show limb, joint angles, sensors and calibration in a terminal, also over ssh.

    The last line shows the keys; q or Ctrl-C ends the monitor. If the daemon or the broker is lost,
    the monitor shows which of them was lost, and reconnects. The environment variable NO_COLOR
    turns colours off. Exit codes: 0 ended by a key; 2 invalid options or rig.toml, no terminal, or
    a missing package; 128 + N stopped by signal N.
    """
    options = (broker, ca, user, password_file, request_key_file)
    if rig is not None and any(option is not None for option in options):
        raise ValueError(
            "--rig and the broker options exclude each other, because rig.toml names the broker"
        )
    if broker is None and rig is None and not any(options[1:]) and _DEFAULT_RIG.is_file():
        rig = _DEFAULT_RIG
    if rig is not None:
        from jointfit_daemon.config import load_rig

        settings = load_rig(rig).mqtt
        if base:
            settings = settings.model_copy(update={"base": base.strip("/")})
    else:
        settings = _broker_settings(
            broker or _DEFAULT_BROKER,
            base=base,
            ca=ca,
            user=user,
            password_file=password_file,
            request_key_file=request_key_file,
        )
    if not _has_terminal():
        raise ValueError(
            "standard input and standard error are not a terminal: use ssh -t HOST jointfit "
            "monitor, or read the topics with mosquitto_sub"
        )
    try:
        from jointfit_daemon.tools.monitor._app import MonitorApp
    except ModuleNotFoundError as missing:
        if (missing.name or "").partition(".")[0] != "textual":
            raise
        raise MonitorUnavailableError from missing
    from jointfit_daemon.tools.monitor._monitor_state import MonitorState

    unicode = not ascii_only and shows_unicode(os.environ)
    state = MonitorState(_address(settings), unicode=unicode)
    code = asyncio.run(_run(MonitorApp(state, settings, updates_hz=rate)))
    if code:
        raise typer.Exit(code)


def _has_terminal() -> bool:
    """Return whether standard input and standard error, which Textual uses, are terminals."""
    return sys.stdin.isatty() and sys.stderr.isatty()


def shows_unicode(environment: Mapping[str, str]) -> bool:
    """Return whether a terminal shows Unicode, from its type and its locale."""
    if environment.get("TERM", "") in _SIMPLE_TERMINALS:
        return False
    # Python sets LC_CTYPE to C.UTF-8 in the locale C, so Python's own locale is not used here.
    locale = environment.get("LC_ALL") or environment.get("LANG") or "UTF-8"
    return "UTF8" in locale.upper().replace("-", "")


def _broker_settings(
    broker: str,
    *,
    base: str | None,
    ca: Path | None,
    user: str | None,
    password_file: Path | None,
    request_key_file: Path | None,
) -> MqttSettings:
    """Return the broker settings from the command-line options.

    Raises
    ------
    ValueError
        An option is invalid, two options contradict each other, or a file is missing.
    """
    from pydantic import ValidationError

    from jointfit_daemon.config import MqttSettings, TlsSettings
    from jointfit_daemon.outputs.mqtt import missing_password

    address = parse_broker(broker, account="use --user and --password-file")
    if address.websocket is not None:
        raise ValueError(f"--broker {broker}: expected mqtt:// or mqtts://, no WebSocket address")
    if ca is not None and not address.tls:
        raise ValueError(f"--ca {ca}: expected with --broker mqtts://HOST only")
    if (user is None) != (password_file is None):
        raise ValueError("--user and --password-file: expected both or none of them")
    for path in (ca, password_file, request_key_file):
        if path is not None:
            path.read_bytes()  # reports a missing file before the screen opens
    try:
        settings = MqttSettings(
            host=address.host,
            port=address.port,
            base=(base or "").strip("/"),
            username=user,
            password_file=None if password_file is None else str(password_file.resolve()),
            tls=TlsSettings(ca=None if ca is None else str(ca.resolve())) if address.tls else None,
            insecure=not address.tls,  # the user chose mqtt://
            request_key_file=None if request_key_file is None else str(request_key_file.resolve()),
        )
    except ValidationError as error:
        raise ValueError(f"--broker {broker}: {error.errors()[0]['msg']}") from None
    if user is not None and (missing := missing_password(settings)) is not None:
        raise ValueError(f"--user {user}: {missing}")
    return settings


def _address(settings: MqttSettings) -> str:
    """Return the address of the broker as text."""
    host = f"[{settings.host}]" if ":" in settings.host else settings.host
    plain = "" if settings.tls or settings.is_local else " (not encrypted)"
    return f"{host}:{settings.tcp_port}{' (TLS)' if settings.tls else plain}"


async def _run(app: MonitorApp) -> int:
    """Run until a key or a signal ends the monitor; return the exit code."""
    loop = asyncio.get_running_loop()
    for number in _STOP_SIGNALS:
        loop.add_signal_handler(number, app.exit, 128 + number)
    try:
        # Without mouse reports, the user can select and copy text on the screen.
        code = await app.run_async(mouse=False)
    finally:
        await app.stop_tasks()
        for number in _STOP_SIGNALS:
            loop.remove_signal_handler(number)
    return code or app.return_code or 0
