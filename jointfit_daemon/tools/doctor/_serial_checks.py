"""Checks of serial ports: presence, permission, other programs, latency."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from jointfit_daemon.device_search import Finding
from jointfit_daemon.tools.discovery import find_serial_ports, read_attribute

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from jointfit_daemon.tools.discovery import SerialPortInfo
    from jointfit_daemon.tools.doctor._host import Host

CHECK = "serial"
MOST_LATENCY_MS = 2
"""Largest acceptable latency timer of an FTDI adapter, ms. A longer timer delays the samples."""
_MODEM_PORTS = ("ttyACM", "ttyUSB")
_DAEMON_NAMES = ("jointfitd", "python")
_RULES = (
    "install 70-jointfitd.rules to /etc/udev/rules.d, then: sudo udevadm control --reload && sudo "
    "udevadm trigger"
)


def check_serial(host: Host, paths: Sequence[str] | None) -> Iterator[Finding]:
    """Yield the findings about serial ports.

    Parameters
    ----------
    host
        The host to check.
    paths
        Ports of rig.toml; the default is all USB adapters of the host.
    """
    ports = find_serial_ports(host.root)
    checked = [port.path for port in ports if port.vendor_id is not None]
    if paths is None and not checked:
        yield Finding(
            CHECK, "", "note", "no USB serial adapter", "connect an adapter, if the rig uses one"
        )
    for path in dict.fromkeys(checked if paths is None else paths):
        found = list(_check_port(host, path, ports))
        yield from found
        if all(each.level == "note" for each in found):
            yield Finding(CHECK, path, "ok", "present, and this user may open it")


def _check_port(host: Host, path: str, ports: Sequence[SerialPortInfo]) -> Iterator[Finding]:
    node = host.at(path)
    if not node.exists():
        listed = ", ".join(port.path for port in ports) or "none"
        yield Finding(
            CHECK, path, "error", f"absent; this host has {listed}",
            "plug it in, or set its path in rig.toml; ls -l /dev/serial/by-id lists the paths",
        )  # fmt: skip
        return
    name = node.resolve().name
    if not host.may_open(node):
        yield _permission(host, path, node)

    # One process, such as the simulator, holds both ends of a pseudo-terminal.
    is_pseudo = node.resolve().is_relative_to(host.at("/dev/pts"))
    holders = [] if is_pseudo else host.holders(node)
    for number, program in holders:
        if program.startswith(_DAEMON_NAMES):
            text = f"in use by {program} (process {number}), as expected while the daemon runs"
            yield Finding(CHECK, path, "note", text)
        else:
            text = (
                f"in use by {program} (process {number}), which reads bytes of the port or locks it"
            )
            yield Finding(CHECK, path, "error", text, f"close this program: kill {number}")
    if name.startswith(_MODEM_PORTS) and _is_probed(host, name):
        yield Finding(
            CHECK, path, "warning", "ModemManager runs, and may open the port when it appears",
            f"{_RULES}; or: sudo systemctl disable --now ModemManager",
        )  # fmt: skip

    info = next((port for port in ports if Path(port.device).name == name), None)
    latency_ms = None if info is None else info.latency_timer_ms
    if latency_ms is not None and latency_ms > MOST_LATENCY_MS:
        text = f"the adapter delays bytes by up to {latency_ms} ms, expected 1 ms"
        remedy = f"echo 1 | sudo tee /sys/class/tty/{name}/device/latency_timer; or {_RULES}"
        if holders:
            yield Finding(CHECK, path, "warning", f"{text}, while a program uses the port", remedy)
        else:
            text += "; the daemon requests 1 ms when it opens the port"
            yield Finding(CHECK, path, "note", text, remedy)


def _permission(host: Host, path: str, node: Path) -> Finding:
    group = host.group_of(node)
    if group in {"root", "0"}:
        return Finding(CHECK, path, "error", "only root may open the port", _RULES)
    if group in host.groups:
        text = f"group {group} may not read and write the port"
        return Finding(CHECK, path, "error", text, _RULES)

    if host.user in host.members(group):
        text = f"user {host.user} joined the group {group} after the login"
        return Finding(CHECK, path, "error", text, f"log out and in, or: newgrp {group}")
    text = f"permission denied: user {host.user} is not in the group {group}"
    remedy = f"sudo usermod -aG {group} {host.user}, then log out and in"
    return Finding(CHECK, path, "error", text, remedy)


def _is_probed(host: Host, name: str) -> bool:
    """Return whether ModemManager runs and no udev rule excludes the port."""
    if not host.is_running("ModemManager"):
        return False
    number = read_attribute(host.root / "sys/class/tty" / name / "dev")
    rules = read_attribute(host.root / f"run/udev/data/c{number}") or ""
    ignored = ("E:ID_MM_DEVICE_IGNORE=1", "E:ID_MM_PORT_IGNORE=1")
    return not any(line in ignored for line in rules.splitlines())
