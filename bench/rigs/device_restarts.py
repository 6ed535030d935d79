"""A live rig whose clocks drift apart and begin anew, judged stamp by stamp.

Law: three processes that know nothing of each other but bytes: virtual hardware with NatNet, two
IMUs on UARTs and two on CAN, the daemon, a broker. Devices reboot one after the other, the next
when all have recovered. Nothing is calibrated, so the constant that no clock can see, the least
delay of each transport, is known from the simulator and taken off.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, NamedTuple

from bench.rigs.timestamp_errors import OPTICAL, WatchedCore, judge, unexcused
from jointfit_daemon.outputs.recording import encode_state, read_events, read_states
from tests.system.station import SENSORS, Listener, Station, running, stopped

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

SKEWS_PPM = {"S1": 50, "S2": -50, "S3": 31, "S4": -23, OPTICAL: 42}
DELAY_MS = {"S1": 2.0, "S2": 1.0, "S3": 2.0, "S4": 1.0}
"""What the simulator's transports take at least; cameras answer echoes and need none."""
EVERY = {*SENSORS, OPTICAL}
PATIENCE_S = 40.0
"""For what takes three seconds where nothing else runs."""


class Outcome(NamedTuple):
    """What became of one run."""

    core: WatchedCore
    replayed: bool
    """The event log gave the limb states of the live run byte for byte."""

    def errors_ns(self, source: str, method: str = "") -> list[int]:
        """Return the errors of all stamps that called themselves synced (and came about so)."""
        return [
            sample.error_ns
            for sample in self.core.samples
            if sample.synced
            and sample.error_ns is not None
            and sample.source == source
            and method in {"", sample.method}
        ]

    def unexcused_ns(self, source: str) -> list[int]:
        """Return what a machine short of time does not excuse of those errors."""
        return [
            unexcused(sample.error_ns, sample.excused_ns)
            for sample in self.core.samples
            if sample.synced and sample.error_ns is not None and sample.source == source
        ]

    @property
    def unknown(self) -> float:
        """Share of samples the simulator knows nothing of."""
        samples = self.core.samples
        return sum(sample.error_ns is None for sample in samples) / max(1, len(samples))

    @property
    def frame_errors_ns(self) -> list[float]:
        """The largest error of each frame that called itself synced."""
        return [frame.worst_ns for frame in self.core.frames if frame.synced]


def locked(listener: Listener) -> bool:
    """Tell whether the newest pose calls itself synced and no clock is settling."""
    devices = listener.latest.get("bridge/health", {}).get("devices", {})
    settled = [device.get("clock") != "settling" for device in devices.values()]
    return (
        bool(listener.poses)
        and listener.poses[-1]["sync"] == "locked"
        and len(settled) == len(EVERY)
        and all(settled)
    )


async def recovers(listener: Listener, name: str) -> None:
    """Wait until a loss is seen, the device is there again, and everything is locked."""
    await listener.until(lambda: not locked(listener) or name not in listener.online, PATIENCE_S)
    before = listener.healths
    await listener.until(
        lambda: name in listener.online and listener.healths > before + 2, PATIENCE_S
    )
    await listener.until(lambda: locked(listener), PATIENCE_S)


async def live(
    folder: Path, port: int, reboots: Sequence[str], rest_s: float, more: Sequence[str] = ()
) -> Outcome:
    """Run a rig; reboot devices one by one; judge what was recorded.

    Parameters
    ----------
    folder, port
        An empty folder; the broker's port.
    reboots
        Sensors, or `mocap`, in order.
    rest_s
        How long the rig runs well before each reboot and at the end.
    more
        Further words for the simulator.
    """
    clocks = [word for name, ppm in SKEWS_PPM.items() for word in ("--clock", f"{name}={ppm}")]
    options = ("--sample-log", "--programme", "walk", *clocks, *more)
    station = Station(folder, port, options, more_toml="[recording]\n")
    async with running(station, PATIENCE_S) as (simulator, daemon, listener):
        await listener.until(lambda: locked(listener), PATIENCE_S)
        for name in reboots:
            await asyncio.sleep(rest_s)
            await simulator.say(f"reboot {name}")
            await recovers(listener, name)
        await asyncio.sleep(rest_s)
        code, _ = await stopped(daemon)
        if code:
            raise RuntimeError(station.log)
    (log,) = (folder / "state" / "recordings").iterdir()
    core, states = judge(read_events(log), folder / "samples.jsonl", DELAY_MS)
    same = [encode_state(state) for state in states] == list(read_states(log))
    return Outcome(core, same)
