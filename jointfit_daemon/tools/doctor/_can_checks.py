"""Checks of CAN network interfaces: presence, state of the controller, bit rate."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.device_search import Finding
from jointfit_daemon.tools.discovery import find_can_interfaces

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from jointfit_daemon.tools.discovery import CanInterface
    from jointfit_daemon.tools.doctor._host import Host

CHECK = "can"
_DEFAULT_BITRATE = 1_000_000
_WIRING = "check that all devices have the same bit rate, and 120 Ω at both ends of the bus"


def check_can(host: Host, bitrates: Mapping[str, int | None] | None) -> Iterator[Finding]:
    """Yield the findings about CAN interfaces.

    Parameters
    ----------
    host
        The host to check.
    bitrates
        SocketCAN interfaces of rig.toml with their configured bit rates, bit/s. With None, all
        interfaces of the host are checked.
    """
    found = {interface.name: interface for interface in find_can_interfaces(host.root, host.run)}
    if bitrates is None and not found:
        yield Finding(
            CHECK, "", "note", "no CAN interface", "connect an adapter, if the rig uses CAN"
        )

    for name in found if bitrates is None else bitrates:
        bitrate = None if bitrates is None else bitrates[name]
        if name not in found:
            listed = ", ".join(found) or "none"
            remedy = "plug the adapter in, or set its channel in rig.toml: ip link show type can"
            yield Finding(CHECK, name, "error", f"absent; this host has {listed}", remedy)
            continue
        findings = list(_check_interface(found[name], bitrate))
        yield from findings
        if all(each.level == "note" for each in findings):
            yield Finding(CHECK, name, "ok", "up")


def _check_interface(interface: CanInterface, wanted: int | None) -> Iterator[Finding]:
    name, state = interface.name, interface.state
    is_virtual = interface.kind != "can"
    rate = wanted or interface.bitrate or _DEFAULT_BITRATE
    kind = "" if is_virtual else f" type can bitrate {rate} restart-ms 100"
    up = f"sudo ip link set {name} up{kind}"
    again = f"sudo ip link set {name} down && {up}"

    if not interface.up:
        yield Finding(CHECK, name, "error", "the interface is down", up)
        return
    if is_virtual:
        return
    if state is None:
        text = "state and bit rate cannot be read: `ip` is absent, or prints no JSON"
        yield Finding(CHECK, name, "unknown", text, "sudo apt install iproute2")
        return

    if state == "BUS-OFF":
        text = "bus-off: the controller stopped after too many errors"
        yield Finding(CHECK, name, "error", text, f"{_WIRING}; then: {again}")
    elif state in ("ERROR-PASSIVE", "ERROR-WARNING"):
        text = f"{state.lower()}: the controller counts errors"
        yield Finding(CHECK, name, "warning", text, _WIRING)
    if wanted is not None and interface.bitrate not in (None, wanted):
        text = f"bit rate {interface.bitrate}, rig.toml expects {wanted} bit/s"
        yield Finding(CHECK, name, "error", text, again)
    if interface.listen_only:
        text = "listen-only: a single sensor on the bus gets no acknowledgment, and stops"
        yield Finding(CHECK, name, "note", text, f"{again} listen-only off")
    if not interface.restart_ms and state != "BUS-OFF":
        text = "the kernel does not restart the controller after bus-off"
        yield Finding(CHECK, name, "note", text, again)
