"""Running daemon whose simulated devices have drifting clocks and restart one after another.

The error of every stamp is measured.

Invariant: three processes exchange only bytes: simulated devices (NatNet, two IMUs on UARTs, two on
CAN), the daemon, and a broker. The devices reboot one after another, each after all devices have
recovered. Without calibration, no clock can estimate the minimum delay of its transport, so the
simulator's value is subtracted.
"""

from __future__ import annotations

import asyncio
from bisect import bisect_left
from typing import TYPE_CHECKING, NamedTuple

from bench.rigs.timestamp_errors import OPTICAL, ObservedCore, judge, unexcused
from jointfit_daemon.outputs.recording import encode_state, open_recording, read_events
from tests.system.station import SENSORS, Listener, Station, running, stopped

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

SKEWS_PPM = {"S1": 50, "S2": -50, "S3": 31, "S4": -23, OPTICAL: 42}
DELAY_MS = {"S1": 2.0, "S2": 1.0, "S3": 2.0, "S4": 1.0}
"""Minimum delay of the simulated transports, ms. Cameras answer echo requests and need no value."""
EVERY = {*SENSORS, OPTICAL}
PATIENCE_S = 40.0
"""Time limit of each wait for a change of the daemon's state, s. On an idle machine, a wait takes
three seconds."""


class RestartRun(NamedTuple):
    """Results of one run."""

    core: ObservedCore
    replayed: bool
    """Whether the replay of the recording yields byte-identical limb states."""

    def errors_ns(self, source: str, method: str = "") -> list[int]:
        """Return the errors of all synced stamps of a source, or of one of its clock methods."""
        return [
            sample.error_ns
            for sample in self.core.samples
            if sample.synced
            and sample.error_ns is not None
            and sample.source == source
            and method in {"", sample.method}
        ]

    def errors_from_cameras_ns(self, source: str, method: str) -> list[int]:
        """Return the errors of a clock method minus the error of the next camera frame, ns."""
        frames = [
            (sample.t_ns, sample.error_ns)
            for sample in self.core.samples
            if sample.source == OPTICAL and sample.synced and sample.error_ns is not None
        ]
        errors = []
        for sample in self.core.samples:
            if (sample.source, sample.method) != (source, method) or not sample.synced:
                continue
            after = bisect_left(frames, (sample.t_ns,))
            if after < len(frames) and sample.error_ns is not None:
                errors.append(sample.error_ns - frames[after][1])
        return errors

    def unexcused_ns(self, source: str) -> list[int]:
        """Return a source's errors without the part that delays of a loaded machine explain, ns."""
        return [
            unexcused(sample.error_ns, sample.excused_ns)
            for sample in self.core.samples
            if sample.synced and sample.error_ns is not None and sample.source == source
        ]

    @property
    def unknown(self) -> float:
        """Share of samples that are not in the simulator's log."""
        samples = self.core.samples
        return sum(sample.error_ns is None for sample in samples) / max(1, len(samples))

    @property
    def frame_errors_ns(self) -> list[float]:
        """Return the largest error of each synced frame, ns."""
        return [frame.worst_ns for frame in self.core.frames if frame.synced]


def locked(listener: Listener) -> bool:
    """Return whether the newest pose is synced and all clocks have converged."""
    devices = listener.latest.get("bridge/health", {}).get("devices", {})
    settled = [device.get("clock") != "settling" for device in devices.values()]
    return (
        bool(listener.poses)
        and listener.poses[-1]["sync"] == "locked"
        and len(settled) == len(EVERY)
        and all(settled)
    )


async def recovers(listener: Listener, name: str) -> None:
    """Wait until the loss is detected, the device is online again, and all clocks are synced."""
    await listener.until(lambda: not locked(listener) or name not in listener.online, PATIENCE_S)
    before = listener.healths
    await listener.until(
        lambda: name in listener.online and listener.healths > before + 2, PATIENCE_S
    )
    await listener.until(lambda: locked(listener), PATIENCE_S)


async def live(
    folder: Path, port: int, reboots: Sequence[str], rest_s: float, more: Sequence[str] = ()
) -> RestartRun:
    """Run a rig, reboot devices one by one, and evaluate the recorded stamps.

    Parameters
    ----------
    folder, port
        Empty folder, and port of the broker.
    reboots
        Sensor ids or `mocap`, in the order of the reboots.
    rest_s
        Time without a fault before each reboot and at the end, s.
    more
        Additional options of the simulator.
    """
    clocks = [word for name, ppm in SKEWS_PPM.items() for word in ("--clock", f"{name}={ppm}")]
    options = ("--sample-log", "--programme", "walk", *clocks, *more)
    station = Station(folder, port, options, more_toml="[recording]\n")
    async with running(station, PATIENCE_S) as (simulator, daemon, listener):
        await listener.until(lambda: locked(listener), PATIENCE_S)
        for name in reboots:
            await asyncio.sleep(rest_s)
            await simulator.send_command(f"reboot {name}")
            await recovers(listener, name)
        await asyncio.sleep(rest_s)
        code, _ = await stopped(daemon)
        if code:
            raise RuntimeError(station.log)
    (log,) = (folder / "state" / "recordings").iterdir()
    core, states = judge(read_events(log), folder / "samples.jsonl", DELAY_MS)
    same = [encode_state(state) for state in states] == list(open_recording(log).states())
    return RestartRun(core, same)
