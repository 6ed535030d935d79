"""CAN interfaces of this host: network interfaces, and interfaces configured in python-can.

Invariant: no interface is opened, and none is changed.
"""

from __future__ import annotations

import configparser
import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import orjson

from jointfit_daemon.tools.discovery._sysfs import read_attribute, read_number

RunCommand = Callable[[Sequence[str]], str | None]
"""Function that returns the output of a command; None if the command is absent or fails."""
_ARPHRD_CAN = 280
"""Number of the hardware type CAN in the kernel."""
_IFF_UP = 1
_IP_TIMEOUT_S = 5.0
_PYTHON_CAN_FILES = ("/etc/can.conf", "~/.can", "~/.canrc", "can.ini")
"""Configuration files of python-can; values of a later file take precedence."""


@dataclass(frozen=True, slots=True)
class CanInterface:
    """One CAN network interface."""

    name: str
    kind: str
    """``can`` for hardware; ``vcan`` or ``vxcan`` for virtual interfaces."""
    up: bool
    state: str | None = None
    """State of the controller: ``ERROR-ACTIVE``, ``ERROR-WARNING``, ``ERROR-PASSIVE``, ``BUS-OFF``
    or ``STOPPED``. None for a virtual interface, or if unknown."""
    bitrate: int | None = None
    """Bit rate, bit/s; None for a virtual interface, or if unknown or not set."""
    restart_ms: int | None = None
    """Time after which the kernel restarts the controller from bus-off, ms; 0 disables the restart.
    """
    listen_only: bool = False
    driver: str | None = None
    """Kernel driver, such as ``gs_usb`` or ``mcp251xfd``."""


@dataclass(frozen=True, slots=True)
class CanChannel:
    """A bus in a configuration file of python-can."""

    interface: str
    """Type of the interface in python-can, such as ``pcan``."""
    channel: str
    bitrate: int | None
    file: str


def run_command(command: Sequence[str]) -> str | None:
    """Return the output of a command; None if the command is absent, fails or is too slow."""
    if shutil.which(command[0]) is None:
        return None
    try:
        done = subprocess.run(  # noqa: S603 - fixed commands without a shell
            command, capture_output=True, text=True, timeout=_IP_TIMEOUT_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


def find_can_interfaces(
    root: Path = Path("/"), run: RunCommand = run_command
) -> list[CanInterface]:
    """Return the CAN interfaces of this host, ordered by name.

    The kernel provides state and bit rate over netlink only. The function therefore runs the
    command ``ip``. Without this command, both values are None.

    Parameters
    ----------
    root
        Folder that contains ``sys``.
    run
        Function that returns the output of a command, or None.
    """
    found = []
    for folder in sorted((root / "sys/class/net").glob("*")):
        if read_number(folder / "type") != _ARPHRD_CAN:
            continue
        link = _link_details(run, folder.name)
        info = link.get("linkinfo") or {}
        data = info.get("info_data") or {}
        timing = data.get("bittiming") or {}
        driver = folder / "device/driver"
        virtual = "can" if (folder / "device").exists() else "vcan"
        flags = read_number(folder / "flags", 16) or 0
        found.append(
            CanInterface(
                name=folder.name,
                kind=str(info.get("info_kind") or virtual),
                up=bool(flags & _IFF_UP) or read_attribute(folder / "operstate") == "up",
                state=data.get("state"),
                bitrate=timing.get("bitrate"),
                restart_ms=data.get("restart_ms", 0) if data else None,
                listen_only="LISTEN-ONLY" in (data.get("ctrlmode") or ()),
                driver=driver.resolve().name if driver.exists() else None,
            )
        )
    return found


def _link_details(run: RunCommand, name: str) -> dict[str, Any]:
    """Return the output of ``ip`` for an interface; empty if ``ip`` is absent or prints no JSON."""
    text = run(["ip", "-details", "-json", "link", "show", "dev", name])
    try:
        links = orjson.loads(text or "[]")
    except orjson.JSONDecodeError:  # BusyBox's ip prints no JSON
        return {}
    first = links[0] if isinstance(links, list) and links else {}
    return first if isinstance(first, dict) else {}


def configured_can_channels(root: Path = Path("/"), home: Path | None = None) -> list[CanChannel]:
    """Return the buses in the configuration files of python-can.

    Parameters
    ----------
    root
        Folder that contains ``etc``.
    home
        Home folder; by default the user's home folder.
    """
    found = []
    for name in _PYTHON_CAN_FILES:
        if name.startswith("~"):
            path = (home or Path(os.path.expanduser("~"))) / name[2:]  # noqa: PTH111 - Path.home raises without a home
        else:
            path = root / name.removeprefix("/") if name.startswith("/") else Path(name)
        parser = configparser.ConfigParser(interpolation=None)
        try:
            parser.read(path, encoding="utf-8")
        except (configparser.Error, UnicodeDecodeError, OSError):
            continue  # python-can reports errors in these files
        for section in parser.sections():
            table = parser[section]
            kind, channel = table.get("interface", table.get("bustype")), table.get("channel")
            if kind and channel:
                rate = table.get("bitrate", "")
                bitrate = int(rate) if rate.isascii() and rate.isdigit() else None
                found.append(CanChannel(kind, channel, bitrate, str(path)))
    return found
