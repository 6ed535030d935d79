"""Search for all rigs on a broker by their retained topic `bridge/info`."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING

import orjson

from jointfit_daemon.outputs import topics
from jointfit_daemon.outputs.mqtt._connection import MqttConnection

if TYPE_CHECKING:
    from jointfit_daemon.config import MqttSettings

_DEEPEST_BASE = 4
"""Largest number of levels of a base topic that the search finds."""
_MOST_RIGS = 100
_LONGEST_BYTES = 256 * 1024
"""Largest incoming packet, bytes."""


async def find_rigs(settings: MqttSettings, patience_s: float) -> dict[str, str]:
    """Return the names of the rigs on a broker, by base topic; `settings.base` is ignored.

    Parameters
    ----------
    settings
        Address of the broker and user account.
    patience_s
        Time to wait for the retained messages, s.

    Raises
    ------
    BrokerLostError
        The broker is absent or disconnected.
    """
    end = f"/{topics.BRIDGE_INFO.pattern}"
    patterns = ["/".join(["+"] * levels) + end for levels in range(1, _DEEPEST_BASE + 1)]
    rigs: dict[str, str] = {}
    async with MqttConnection(settings, longest_bytes=_LONGEST_BYTES) as connection:
        await connection.subscribe(patterns)
        with suppress(TimeoutError):
            async with asyncio.timeout(patience_s):
                async for message in connection.messages():
                    name = _rig_name(message.payload)
                    if name is not None and len(rigs) < _MOST_RIGS:
                        rigs[message.topic.removesuffix(end)] = name
    return rigs


def _rig_name(payload: bytes) -> str | None:
    """Return the name in a payload of `bridge/info`; None for any other payload."""
    try:
        info = orjson.loads(payload)
    except orjson.JSONDecodeError:
        return None
    name = info.get("rig") if isinstance(info, dict) else None
    return name if isinstance(name, str) else None
