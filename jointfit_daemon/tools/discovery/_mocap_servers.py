"""Motion-capture servers that the installed drivers find."""

from __future__ import annotations

import asyncio
import logging
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, cast

from jointfit_daemon.device_search import FoundServer
from jointfit_daemon.driver import ENTRY_POINT_GROUP, driver_names, find_driver

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from jointfit_daemon.device_search import ServerSearch
    from jointfit_daemon.driver import Driver

log = logging.getLogger(__name__)

__all__ = ["FoundServer", "find_mocap_servers", "installed_drivers"]


def installed_drivers() -> Iterator[tuple[str, type[Driver]]]:
    """Yield name and class of every driver; log a warning if a driver cannot be imported."""
    for name in driver_names():
        try:
            yield name, find_driver(name)
        except Exception as error:  # noqa: BLE001 - a broken plug-in must not hide the others
            package = next(iter(entry_points(group=ENTRY_POINT_GROUP, name=name))).value
            log.warning("driver %s: %s cannot be imported: %s", name, package, error)


async def find_mocap_servers(
    hosts: Sequence[str] = (),
    *,
    broadcast: bool = False,
    port: int | None = None,
    wait_s: float = 1.0,
) -> list[FoundServer]:
    """Return the motion-capture servers that answer a request of an installed driver.

    Parameters
    ----------
    hosts
        Names or addresses of the hosts to ask.
    broadcast
        Whether to ask all hosts in the networks of this host, with one datagram per network.
    port
        Command port; the default is the usual port of each system.
    wait_s
        Time to wait for answers, s.

    Raises
    ------
    OSError
        The name of a host is unknown, or the network cannot be used.
    """

    async def ask(search: ServerSearch) -> list[FoundServer] | OSError:
        try:
            return await search.find_servers(hosts, broadcast=broadcast, port=port, wait_s=wait_s)
        except OSError as error:  # the other searches continue
            return error

    # Search with all drivers at the same time to shorten the wait.
    async with asyncio.TaskGroup() as group:
        asked = [
            group.create_task(ask(cast("ServerSearch", cast("Any", driver))))
            for _, driver in installed_drivers()
            if hasattr(driver, "find_servers")
        ]
    found: list[FoundServer] = []
    for task in asked:
        answered = task.result()
        if isinstance(answered, OSError):
            raise answered
        found += answered
    return found
