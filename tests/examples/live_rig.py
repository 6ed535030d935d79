"""Replacement for the daemon: it publishes a fixed pose at 10 Hz with the daemon's encoders."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Literal

from jointfit_daemon.config import MqttSettings
from jointfit_daemon.outputs.mqtt._connection import MqttConnection, Outgoing
from jointfit_daemon.outputs.payloads import encode_joint, encode_pose
from tests.outputs.payloads.test_payloads import STATE

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

BASE = "jointfit/bench-1"
PERIOD_S = 0.1
SHOWN = "knee flexion 28.31° ± 1.4°"
"""Text that a subscriber prints for the pose published here."""


@contextlib.asynccontextmanager
async def live_rig(
    port: int, version: Literal["5", "3.1.1"] = "5"
) -> AsyncIterator[MqttConnection]:
    """Publish `STATE`, a limb state, on ``pose/ui`` and ``joint/knee``; yield the connection.

    The embedded broker connects publishers and subscribers of the same MQTT version only.
    """
    settings = MqttSettings(host="127.0.0.1", port=port, base=BASE, version=version)
    async with MqttConnection(settings) as connection:

        async def publish() -> None:
            t_us = 1_700_000_000_000_000
            while True:
                t_us += 100_000
                pose = encode_pose(STATE, t_us * 1000 - STATE.t_ns, STATE.t_ns)
                await connection.publish(Outgoing(f"{BASE}/pose/ui", pose))
                joint = encode_joint(STATE, 1, t_us)
                await connection.publish(Outgoing(f"{BASE}/joint/knee", joint))
                await asyncio.sleep(PERIOD_S)

        task = asyncio.create_task(publish(), name="live rig")
        try:
            yield connection
        finally:
            task.cancel()
            await asyncio.wait([task])


async def first_line(*command: str | Path) -> str:
    """Return the first line that a program prints, and kill the program."""
    process = await asyncio.create_subprocess_exec(
        *map(str, command), stdout=asyncio.subprocess.PIPE
    )
    try:
        assert process.stdout is not None
        async with asyncio.timeout(20):
            return (await process.stdout.readline()).decode().strip()
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.communicate()
