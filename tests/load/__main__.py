"""``make load``: the daemon at the full rate of its inputs; every sample must have an outcome.

Four IMUs fill serial lines of 921 600 baud. A sensor and the frames of other devices fill a CAN
bus. Cameras send 60 markers at 300 Hz. The samples are counted during a pause before and a pause
after the given time of sending. The command returns 1 if a sample was not received, was lost,
corrupt or dropped, or has no outcome, or if an input sent less than 98 % of its samples.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from jointfit_daemon.calibration.record import CalibrationStore
from jointfit_daemon.config import load_rig
from jointfit_daemon.tools.child_processes import daemon
from jointfit_protocols.can import CanFrame, frame_bits
from jointfit_simulators.devices import (
    NatNetServer,
    NatNetServerOptions,
    RigidBodyAsset,
    XbusDevice,
    XbusDeviceOptions,
    XcdiDevice,
)
from jointfit_simulators.wires import SlcanAdapter
from tests.broker_fixture import chosen_broker
from tests.faults.run import PAGE, render, stored
from tests.limb_model.plain_calibration import plain_calibration
from tests.load.table import COUNTERS, RESULTS, faults_of, table_of
from tests.system.station import OUTCOMES, Listener, broker

if TYPE_CHECKING:
    from collections.abc import Callable

BASE = "jointfit/load"
SERIAL = ("S1", "S2", "S3", "S4")
RATES_HZ = dict.fromkeys(SERIAL, 400) | {"S5": 100, "mocap": 300}
BITRATE = 500_000
STRANGER = CanFrame(0, 0x123, bytes(8))
STRANGERS_HZ = BITRATE // frame_bits(8, extended=False) - 4 * RATES_HZ["S5"]
"""Number of frames of other devices, frames/s, that fill the bus together with the four frames of
each sample."""
MARKERS = tuple(f"M{number}" for number in range(60))
SETTLE_S = 2.0
"""Pause of the inputs before they are counted, s."""
OUTPUTS = (
    *XbusDeviceOptions().outputs[:-1],
    *((item, 400) for item in (0x2013, 0x4023, 0x8023, 0xC023, 0x4033, 0x4013, 0x8033)),
)
"""Items in double precision that fill 99 % of a line of 921 600 baud at 400 Hz."""
RIG = """
[rig]
name = "load"
[chain]
joints = ["hip", "knee"]
segments = ["thigh"]
[mqtt]
host = "127.0.0.1"
port = {port}
base = "{base}"
health_s = 0.5
[can.can0]
interface = "slcan"
channel = "{folder}/can"
bitrate = {bitrate}
[[imu]]
id = "S5"
segment = "thigh"
driver = "xcdi"
can = "can0"
silence_s = 30
[mocap]
driver = "natnet"
server = "127.0.0.1"
command_port = {mocap}
silence_s = 30
markers.thigh = ["M0", "M1", "M2"]
"""
IMU = """
[[imu]]
id = "{name}"
segment = "thigh"
driver = "xbus"
port = "{folder}/{name}"
baud = 921600
rate_hz = 400
silence_s = 30
"""


Sources: TypeAlias = "tuple[tuple[int, Callable[[float], object]], ...]"
"""Rate of each source, Hz, and the function that sends the sample of a given time, s."""


class Inputs:
    """Simulated devices that send together, and pause together."""

    def __init__(self, folder: Path) -> None:
        thigh = RigidBodyAsset("Thigh", MARKERS, 1)
        self.server = NatNetServer(NatNetServerOptions(bodies=(thigh,), rate_hz=RATES_HZ["mocap"]))
        self.bus = SlcanAdapter(folder / "can")
        self.can = XcdiDevice(self.bus)
        options = XbusDeviceOptions(outputs=OUTPUTS)
        self.imus = {name: XbusDevice(folder / name, options=options) for name in SERIAL}
        self.sending = True
        self._began_ns = time.monotonic_ns()
        self._places = {
            name: (0.01 * k, 0.2 * (k % 3), 0.3 + 0.1 * (k % 2)) for k, name in enumerate(MARKERS)
        }

    @property
    def sent(self) -> dict[str, int]:
        """Number of samples or frames that each input has sent."""
        found = {name: device.sent for name, device in self.imus.items()}
        return found | {"S5": self.can.sent, "mocap": self.server.sent}

    def _push_imus(self, t_s: float) -> None:
        for device in self.imus.values():
            device.push(round(t_s * 1e9), _turned(t_s))

    def _push_frame(self, t_s: float) -> None:
        body = {"Thigh": ((0.0, 0.0, 0.3), (1.0, 0.0, 0.0, 0.0))}
        self.server.push(self._began_ns + round(t_s * 1e9), self._places, body)

    async def run(self) -> None:
        """Serve the devices and send until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            parts: tuple[SlcanAdapter | NatNetServer | XbusDevice, ...]
            parts = (self.server, self.bus, *self.imus.values())
            for part in parts:
                tasks.create_task(part.run())
            sources: Sources = (
                (RATES_HZ["S1"], self._push_imus),
                (RATES_HZ["S5"], lambda t_s: self.can.push(round(t_s * 1e9), _turned(t_s))),
                (STRANGERS_HZ, lambda _: self.bus.send([STRANGER])),
                (RATES_HZ["mocap"], self._push_frame),
            )
            tasks.create_task(self._send(sources))

    async def _send(self, sources: Sources) -> None:
        """Send at the rates of the sources; after a pause of this process, send all due samples.

        Samples and frames are sent in the order of their times, as on a bus.
        """
        numbers = [0] * len(sources)
        while True:
            passed_s = (time.monotonic_ns() - self._began_ns) / 1e9
            due: list[tuple[float, int]] = []
            for at, (rate_hz, _) in enumerate(sources):
                until = int(passed_s * rate_hz)
                due += [(number / rate_hz, at) for number in range(numbers[at] + 1, until + 1)]
                numbers[at] = until
            if self.sending:
                for t_s, at in sorted(due):
                    sources[at][1](t_s)
            await asyncio.sleep(0.002)


def _turned(t_s: float) -> tuple[float, float, float, float]:
    half = math.sin(t_s) / 2
    return math.cos(half), math.sin(half), 0.0, 0.0


async def measure(folder: Path, port: int, seconds: float) -> dict[str, Any]:
    """Send for `seconds`; return the numbers of sent samples and of their outcomes."""
    inputs = Inputs(folder)
    values = {"port": port, "base": BASE, "folder": folder, "bitrate": BITRATE}
    text = RIG.format(mocap=inputs.server.command_port, **values)
    text += "".join(IMU.format(name=name, folder=folder) for name in SERIAL)
    (folder / "rig.toml").write_text(text, "utf-8")
    rig = load_rig(folder / "rig.toml")
    store = CalibrationStore(folder / "state" / "calibrations", rig.calibration_store)
    store.save(plain_calibration(rig.chain))
    topics = ("bridge/health", "bridge/event", "device/+/availability")
    listener = Listener(broker(port, BASE), topics)

    async def counted() -> tuple[dict[str, int], dict[str, Any]]:
        inputs.sending = False
        await asyncio.sleep(SETTLE_S)
        await listener.health()
        return inputs.sent, await listener.health()

    tasks = [asyncio.create_task(part.run()) for part in (inputs, listener)]
    try:
        async with daemon(folder, folder / "rig.toml") as child:
            await listener.connected(RATES_HZ)
            await asyncio.sleep(SETTLE_S)
            sent_before, before = await counted()
            listener.events.clear()
            inputs.sending = True
            await _report_drops(listener, before, seconds)
            sent, after = await counted()
            child.check()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)

    if listener.events:
        print(listener.format_events())
    found = {}
    for name, rate_hz in RATES_HZ.items():
        device = after[name]
        keys = ("received", *COUNTERS, "restarts")  # a restart of a clock drops pending samples
        grown = {key: device[key] - before[name][key] for key in keys}
        outcomes = sum(device[key] for key in OUTCOMES) + device["pending"]
        found[name] = grown | {
            "rate_hz": rate_hz,
            "sent": sent[name] - sent_before[name],
            "unaccounted": device["received"] - outcomes if name != "mocap" else 0,
        }
    return {"seconds": seconds, "inputs": found}


async def _report_drops(listener: Listener, before: dict[str, Any], seconds: float) -> None:
    """Wait for `seconds`; print when samples are dropped, because the cause may be brief."""
    began_s = time.monotonic()
    dropped = {name: before[name]["dropped"] for name in RATES_HZ}
    while (passed_s := time.monotonic() - began_s) < seconds:
        devices = listener.latest["bridge/health"]["devices"]
        for name, count in dropped.items():
            if (now := devices[name]["dropped"]) != count:
                dropped[name] = now
                print(
                    f"{name}: {now - count} samples dropped, {passed_s:.1f} s after the start",
                    flush=True,
                )
        await asyncio.sleep(min(0.5, seconds - passed_s))


def main() -> int:
    """Run, and return 1 if an input has a fault (`faults_of`)."""
    parser = argparse.ArgumentParser(prog="make load", description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0, help="time of sending")
    parser.add_argument("--store", action="store_true", help="store the counts for the page")
    options = parser.parse_args()
    if not options.minutes > 0:
        parser.error(f"--minutes: expected a number above 0, got {options.minutes:g}")
    with tempfile.TemporaryDirectory() as name:
        chosen = chosen_broker()(Path(name))
        chosen.start()
        try:
            results = asyncio.run(measure(Path(name), chosen.port, 60.0 * options.minutes))
        finally:
            chosen.stop()
    print(table_of(results))
    if options.store:
        RESULTS.write_text(json.dumps(results, indent=1, sort_keys=True) + "\n", "utf-8")
        PAGE.write_text(render(stored()), "utf-8")
    faults = faults_of(results)
    print("\n".join(faults) or "every sample was received and has an outcome")
    return 1 if faults else 0


sys.exit(main())
