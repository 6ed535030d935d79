"""Simulated cameras and CAN sensor of the fault scenarios, with faults that can be switched on."""

from __future__ import annotations

import asyncio
import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING

from typing_extensions import override  # typing has it from Python 3.12

from jointfit_protocols.natnet import (
    BodyDescription,
    MarkerSetDescription,
    ModelDefinition,
    SkeletonDescription,
)
from jointfit_simulators.devices import (
    NatNetServer,
    NatNetServerOptions,
    RigidBodyAsset,
    XcdiDevice,
)
from jointfit_simulators.wires import SlcanAdapter

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_protocols.natnet import Message, Version
    from jointfit_simulators.devices import Address

PERIOD_S = 0.01
MARKERS = ("T1", "T2", "T3")
FAR_NS = 1_000_000_000_000
"""Time of the server's clock at its first frame, ns; far from the time of the host."""


class CameraServer(NatNetServer):
    """Server with a skeleton in its description, or behind a firewall, if a test requires it."""

    firewall = False
    """Whether datagrams in both directions are dropped without an answer."""
    skeleton = False
    """Whether the model description begins with a skeleton, before the rigid body."""

    @override
    def _handle(self, data: bytes, address: Address) -> None:
        if not self.firewall:
            super()._handle(data, address)

    @override
    def _send(self, message: Message, address: Address, version: Version = (3, 0)) -> None:
        if self.firewall:
            return
        if self.skeleton and isinstance(message, ModelDefinition):
            bone = BodyDescription("Hip", 1)
            person = (
                MarkerSetDescription("Anna", MARKERS),
                SkeletonDescription("Anna", 1, (bone,)),
            )
            message = ModelDefinition((*person, *message.descriptions))
        super()._send(message, address, version)


class Cameras:
    """A motion-capture server with three markers on the thigh at 100 Hz."""

    def __init__(self) -> None:
        self.lag_ns = 0
        """Host clock minus server clock, ns. It increases when a played recording loops."""
        bodies = (RigidBodyAsset("Thigh", MARKERS, 1),)
        self.server = CameraServer(
            NatNetServerOptions(bodies=bodies, device_ns=lambda host_ns: host_ns - self.lag_ns)
        )
        self.hidden = False
        """Whether T3 is occluded."""
        self.answering: asyncio.Task[None] | None = None

    def set_options(self, **changed: object) -> None:
        """Change options of the server; its clients see the change after they connect again."""
        self.server.options = replace(self.server.options, **changed)  # type: ignore[arg-type]
        self.server.set_bodies(self.server.options.bodies)

    def push(self, number: int) -> None:
        """Send one frame."""
        x = 0.1 * math.sin(0.02 * number)
        places = {name: (x + 0.1 * k, 0.2 * (k % 2), 0.3) for k, name in enumerate(MARKERS)}
        shown = places | ({"T3": None} if self.hidden else {})
        if not self.server.firewall:
            body = {"Thigh": (places["T1"], (1.0, 0.0, 0.0, 0.0))}
            self.server.push(time.monotonic_ns(), shown, body)

    async def run(self) -> None:
        """Answer, and send frames, until cancelled."""
        answering = asyncio.create_task(self.server.run())
        number = 0
        try:
            while True:
                number += 1
                self.push(number)
                await asyncio.sleep(PERIOD_S)
        finally:
            answering.cancel()
            await asyncio.wait([answering])
            self.server.unplug()


class CanSensor:
    """A moving IMU on an SLCAN adapter."""

    def __init__(self, link: Path) -> None:
        self.bus = SlcanAdapter(link)
        self.device = XcdiDevice(self.bus)

    async def run(self) -> None:
        """Serve the adapter and send samples until cancelled."""
        serving = asyncio.create_task(self.bus.run())
        number, began_s = 0, time.monotonic()
        try:
            while True:
                while number < (time.monotonic() - began_s) / PERIOD_S:
                    number += 1
                    angle = math.sin(2.0 * number * PERIOD_S)
                    q = (math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0)
                    self.device.push(round(number * PERIOD_S * 1e9), q)
                await asyncio.sleep(PERIOD_S / 2)
        finally:
            serving.cancel()
            await asyncio.wait([serving])
            self.bus.unplug()
