"""Simulated Vicon DataStream server on the loopback interface.

Every rigid body is a prop: a Vicon subject with one segment of the same name. A frame contains no
object for a body that is not visible.

Invariant: static objects are sent once after each change. The following frames list them as
unchanged.
"""

from __future__ import annotations

import asyncio
import random
import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from jointfit_daemon.units import MM_PER_M, NS_PER_S
from jointfit_protocols import vicon
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.vicon import ObjectId
from jointfit_simulators.devices._natnet_frames import axes_from_z_up
from jointfit_simulators.devices._natnet_options import same_clock
from jointfit_simulators.devices._rotations import rotation_rows, rotation_vector
from jointfit_simulators.devices._tcp_port import TcpPort
from jointfit_simulators.imu_device import WireNoise, clean_wire

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_protocols.vicon import Object
    from jointfit_simulators.devices._natnet_frames import (
        Axis,
        Bodies,
        Markers,
        Pose,
        RigidBodyAsset,
    )
    from jointfit_simulators.devices._tcp_port import TcpClient

_RADIUS_MM = 7.0
_HUGE = struct.pack("<I", 2**32 - 1)
_OFFER = frozenset((
    ObjectId.STREAM_INFO, ObjectId.SUBJECT_INFO, ObjectId.FRAME_INFO, ObjectId.LABELED_RECONS,
    ObjectId.LOCAL_SEGMENTS, ObjectId.GLOBAL_SEGMENTS, ObjectId.LATENCY_INFO,
    ObjectId.HARDWARE_FRAME, ObjectId.APPLICATION_INFO, ObjectId.FRAME_RATES,
    ObjectId.OBJECT_QUALITY, ObjectId.PING, ObjectId.CONTENTS,
))  # fmt: skip


@dataclass(frozen=True, slots=True)
class ViconServerOptions:
    """Constant properties of a server."""

    bodies: tuple[RigidBodyAsset, ...] = ()
    command_port: int = 0
    """TCP port on the loopback interface; 0 selects a free port."""
    up_axis: Axis = "z"
    """Vertical axis that the server announces, ``z`` or ``y``."""
    rate_hz: float = 120.0
    device_ns: Callable[[int], int] = same_clock
    """Conversion from host CLOCK_MONOTONIC to the camera clock, both in ns."""
    stages: tuple[tuple[str, float], ...] = (("Processing", 0.003), ("Streaming", 0.001))
    """Announced latency of each processing stage, s."""
    light: bool = False
    """Whether the server offers light-weight segment data only."""
    pieces: int = 1
    """Number of TCP segments per frame."""
    hostile: float = 0.0
    """Probability that a frame contains a wrong count or length."""
    wire_noise: WireNoise = clean_wire
    """Noise applied to each frame."""
    seed: int = 1


@dataclass(slots=True)
class ViconClient:
    """State of one client."""

    wire: TcpClient
    stream: vicon.ViconStream = field(default_factory=vicon.ViconStream)
    wanted: frozenset[int] = frozenset()
    streams: bool = False
    frames: int = 0
    """Number of requested single frames that are not yet sent."""
    informed: frozenset[int] = frozenset()
    """Types of static objects whose current state the client has received."""


class ViconServer:
    """Simulated server. Its port is open from the start, and `run` answers requests.

    Attributes
    ----------
    ready : asyncio.Event
        Event that is set while `run` answers.
    number : int
        Number of the next frame, from 0; tests can set it to simulate a jump.
    quality : float
        Tracking quality of all subjects, 0 to 1.
    """

    def __init__(self, options: ViconServerOptions | None = None) -> None:
        self.options = options or ViconServerOptions()
        self._port = TcpPort(self.options.command_port)
        self.command_port = self._port.port
        """TCP port of the DataStream."""
        self._clients: dict[TcpClient, ViconClient] = {}
        self._bodies = self.options.bodies
        self._place, self._turn = axes_from_z_up(self.options.up_axis)
        self._random = random.Random(self.options.seed)  # noqa: S311 - the same draws in every run
        self.ready = asyncio.Event()
        self.number = 0
        self.quality = 1.0
        self.sent = 0
        """Number of sent frames, summed over the clients."""
        self._began_ns: int | None = None
        self.offer = _OFFER
        if self.options.light:
            self.offer = _OFFER - {ObjectId.GLOBAL_SEGMENTS} | {ObjectId.LIGHT_SEGMENTS}

    async def run(self) -> None:
        """Answer requests until cancelled."""
        self.ready.set()
        try:
            await self._port.serve(self._join, self._handle)
        finally:
            self.ready.clear()

    def unplug(self) -> None:
        """Close the port and disconnect all clients."""
        self._port.unplug()
        self._clients.clear()

    def plug(self) -> None:
        """Open the same port again."""
        self._port.plug()

    def restart(self) -> None:
        """Close and reopen the server; frame numbers restart from 0."""
        self.unplug()
        self.plug()
        self.number, self._began_ns = 0, None

    def set_bodies(self, bodies: tuple[RigidBodyAsset, ...]) -> None:
        """Replace the subjects during the run; clients then receive the static objects again."""
        self._bodies = bodies
        self.refresh()

    def refresh(self) -> None:
        """Send all static objects with the next frame."""
        for client in self._clients.values():
            client.informed = frozenset()

    def push(self, exposure_host_ns: int, markers: Markers, bodies: Bodies) -> None:
        """Send one frame now.

        Parameters
        ----------
        exposure_host_ns : int
            Instant of the exposure, host CLOCK_MONOTONIC, ns. It is independent of the time of
            sending.
        markers : mapping of str to (x, y, z) or None
            Position in the world (z up), m; None if occluded. Markers without a body are not sent.
        bodies : mapping of str to (position, quaternion) or None
            Position in the world (z up), m, and q_world_body (w, x, y, z); None if untracked.
        """
        device_ns = self.options.device_ns(exposure_host_ns)
        if self._began_ns is None:
            self._began_ns = device_ns
        # The cameras count exposures on their own clock, from an arbitrary number.
        hardware = round((device_ns - self._began_ns) * self.options.rate_hz / NS_PER_S)
        dynamic = self._dynamic(hardware, markers, bodies)
        self.number += 1
        for client in tuple(self._clients.values()):
            if client.streams or client.frames:
                client.frames = max(0, client.frames - 1)
                self._send_frame(client, dynamic)

    def _send_frame(self, client: ViconClient, dynamic: list[tuple[int, Object]]) -> None:
        static = [(kind, item) for kind, item in self._static() if kind in client.wanted]
        unchanged = frozenset(kind for kind, _ in static) & client.informed
        found = [(kind, item) for kind, item in static if kind not in unchanged]
        found += [(kind, item) for kind, item in dynamic if kind in client.wanted]
        client.informed |= frozenset(kind for kind, _ in static)

        objects = [item for _, item in found]
        if ObjectId.CONTENTS in client.wanted:
            kinds = [kind for kind, _ in found]
            present = tuple((kind, kinds.count(kind)) for kind in dict.fromkeys(kinds))
            objects.append(vicon.Contents(present, unchanged))
        data = vicon.encode(*objects)
        if self._random.random() < self.options.hostile:
            at = self._random.choice((12, 20, 24))
            data = data[:at] + _HUGE + data[at + 4 :]
        data = self.options.wire_noise(data)
        self.sent += client.wire.send(data, pieces=self.options.pieces)

    # --- objects ------------------------------------------------------------------------------

    def _static(self) -> list[tuple[int, Object]]:
        options = self.options
        period = round(vicon.TICKS_PER_S / options.rate_hz)
        found: list[tuple[int, Object]] = [
            (ObjectId.STREAM_INFO, vicon.StreamInfo(period)),
            (ObjectId.APPLICATION_INFO, vicon.ApplicationInfo(int(options.up_axis == "y"))),
        ]

        # The numbers of subjects, markers and segments begin at 1.
        for number, body in enumerate(self._bodies, 1):
            markers = tuple(
                vicon.MarkerInfo(marker, name) for marker, name in enumerate(body.markers, 1)
            )
            root = (vicon.SegmentInfo(0, 1, body.name),)
            info = vicon.SubjectInfo(number, body.name, root, markers)
            found.append((ObjectId.SUBJECT_INFO, info))
            quality = vicon.ObjectQuality(number, self.quality)
            found.append((ObjectId.OBJECT_QUALITY, quality))
        return found

    def _dynamic(self, hardware: int, markers: Markers, bodies: Bodies) -> list[tuple[int, Object]]:
        rate_hz = self.options.rate_hz
        found: list[tuple[int, Object]] = [
            (ObjectId.FRAME_INFO, vicon.FrameInfo(self.number)),
            (ObjectId.HARDWARE_FRAME, vicon.HardwareFrame(hardware)),
            (ObjectId.LATENCY_INFO, vicon.LatencyInfo(self.options.stages)),
            (ObjectId.FRAME_RATES, vicon.FrameRates((("Camera", rate_hz),))),
        ]

        # Omit markers and segments that are not visible.
        recons = []
        for subject, body in enumerate(self._bodies, 1):
            for marker, name in enumerate(body.markers, 1):
                at = markers.get(name)
                if at is not None:
                    x, y, z = self._place(*at)
                    recons.append(
                        vicon.LabeledRecon(
                            subject, marker, _RADIUS_MM, x * MM_PER_M, y * MM_PER_M, z * MM_PER_M
                        )
                    )
            pose = bodies.get(body.name)
            if pose is not None:
                found += self._segments(subject, pose)
        found.append((ObjectId.LABELED_RECONS, vicon.LabeledRecons(tuple(recons))))
        return found

    def _segments(self, subject: int, pose: Pose) -> list[tuple[int, Object]]:
        x, y, z = (value * MM_PER_M for value in self._place(*pose[0]))
        q = self._turn(*pose[1])
        rotation = tuple(value for row in rotation_rows(q) for value in row)
        segment = (vicon.SegmentPose(1, (x, y, z), rotation),)
        light = vicon.LightSegment(1, x, y, z, *rotation_vector(q))
        return [
            (ObjectId.LOCAL_SEGMENTS,
             vicon.Segments(ObjectId.LOCAL_SEGMENTS, subject, segment)),
            (ObjectId.GLOBAL_SEGMENTS,
             vicon.Segments(ObjectId.GLOBAL_SEGMENTS, subject, segment)),
            (ObjectId.LIGHT_SEGMENTS, vicon.LightSegments(subject, (light,))),
        ]  # fmt: skip

    # --- requests -----------------------------------------------------------------------------

    def _join(self, wire: TcpClient) -> None:
        self._clients = {w: c for w, c in self._clients.items() if w in self._port.clients}
        self._clients[wire] = ViconClient(wire)
        wire.send(vicon.encode(vicon.ObjectEnums(self.offer)))

    def _handle(self, wire: TcpClient, data: bytes) -> None:
        client = self._clients.get(wire)
        if client is None:
            return
        for raw in client.stream.feed(data):
            packet = raw if isinstance(raw, CorruptBytes) else vicon.decode(raw)
            for item in packet.objects if isinstance(packet, vicon.Packet) else ():
                self._request(client, item)

    def _request(self, client: ViconClient, item: Object) -> None:
        match item:
            case vicon.ObjectEnums(ids):
                # Send newly requested static objects in full.
                client.informed &= client.wanted
                client.wanted = ids & self.offer
            case vicon.RequestFrame(stream):
                client.streams = stream
                client.frames += not stream
            case vicon.ViconPing():
                client.wire.send(vicon.encode(item))
            case _:
                return
