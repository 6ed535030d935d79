"""Combination of searches for servers at several addresses."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Coroutine, Sequence
    from typing import Any

    from jointfit_daemon.device_search import FoundServer

    Search = Coroutine[Any, Any, list[FoundServer]]


async def gather_servers(named: Sequence[Search], searched: Sequence[Search]) -> list[FoundServer]:
    """Return the servers that several searches find, without repetitions, sorted by address.

    Parameters
    ----------
    named : sequence of coroutines
        Searches at named hosts. Their answers also contain the names of markers and bodies.
    searched : sequence of coroutines
        Searches in networks. A named host may also answer these searches.
    """
    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(search) for search in (*named, *searched)]
    found = [server for task in tasks for server in task.result()]
    unique = {(server.server, server.port): server for server in reversed(found)}
    return sorted(unique.values(), key=lambda server: (server.server, server.port))
