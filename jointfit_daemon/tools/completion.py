"""Words that a shell offers after Tab, by argument.

Each list is imported only when a shell asks for it, because most need the packages of the daemon.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable


def complete_driver(incomplete: str) -> list[str]:
    """Return the installed drivers that begin with `incomplete`."""
    from jointfit_daemon.driver import driver_names

    return _beginning_with(incomplete, driver_names())


def complete_request(incomplete: str) -> list[str]:
    """Return the requests that begin with `incomplete`."""
    from jointfit_daemon.supervisor.requests import REQUESTS

    return _beginning_with(incomplete, REQUESTS)


def complete_serial_port(incomplete: str) -> list[str]:
    """Return the paths of serial ports that begin with `incomplete`."""
    from jointfit_daemon.tools.discovery import find_serial_ports

    ports = find_serial_ports()
    return _beginning_with(incomplete, [path for p in ports for path in (p.path, p.device)])


def complete_can_interface(incomplete: str) -> list[str]:
    """Return the CAN interfaces that begin with `incomplete`."""
    from jointfit_daemon.tools.discovery import find_can_interfaces

    return _beginning_with(incomplete, [interface.name for interface in find_can_interfaces()])


def complete_topic(incomplete: str) -> list[str]:
    """Return the topics and requests with a JSON Schema that begin with `incomplete`."""
    from jointfit_daemon.outputs.payload_models import PAYLOADS
    from jointfit_daemon.supervisor.requests import REQUESTS

    requests = (f"bridge/request/{name}" for name in REQUESTS)
    return _beginning_with(incomplete, [*(topic.pattern for topic in PAYLOADS), *requests])


def _beginning_with(incomplete: str, names: Iterable[str]) -> list[str]:
    return [name for name in names if name.startswith(incomplete)]
