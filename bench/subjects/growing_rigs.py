"""Rigs with any number of sensors, segments and markers, with a calibration and device bytes.

The sensors are Xbus devices at 100 Hz on a chain of equal segments, which swing in a plane. All
sensors of a segment have its orientation. A segment with two sensors has the calibration of the
simulated subject; other segments use the mean of their sensors. With markers, a NatNet server sends
a frame for each frame of the sensors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from math import cos, pi, sin
from typing import TYPE_CHECKING

from bench.subjects.device_bytes import BITSTREAM, TICK_NS, xbus_message
from bench.subjects.simulated_wearer import bench_rig, fitted
from jointfit_daemon.config import parse_rig
from jointfit_daemon.kinematics.rotation_scalar import rotate_one
from jointfit_daemon.limb_model import (
    Calibration,
    JointCalibration,
    SegmentCalibration,
    SensorCalibration,
    StoredCluster,
    neighbor,
)
from jointfit_daemon.model import Chunk
from jointfit_daemon.pipeline.events import ChunkArrived
from jointfit_daemon.units import NS_PER_S
from jointfit_protocols.natnet import ServerInfo, encode
from jointfit_simulators.devices import (
    FrameStamps,
    NatNetFrameBuilder,
    RigidBodyAsset,
    model_definition,
)

if TYPE_CHECKING:
    from typing import Any

    from jointfit_daemon.config import Rig
    from jointfit_daemon.limb_model import SensorLink
    from jointfit_daemon.model import Chain, Quaternion, Vector

PERIOD_NS = 10_000_000
BEGIN_NS = 1_000 * NS_PER_S
STAGGER_NS = 200_000
"""Time between the arrivals of two sensors in one frame, ns."""
CAMERA_DELAY_NS = 9_000_000
"""Time from the exposure of a camera frame to its arrival, ns."""
SWING, SWING_HZ = 0.6, 0.8
"""Amplitude, rad, and frequency, Hz, of every segment's swing."""
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
_SERVER = ServerInfo("Motive", (2, 3, 0, 0), (*BITSTREAM, 0, 0), 10_000_000)


@dataclass(frozen=True)
class GrowingRig:
    """A rig, its calibration and the bytes of its devices."""

    segments: int
    sensors: int
    """Number of sensors of each segment."""
    markers: int = 0
    """Number of markers of the first segment; 0 for a rig without cameras."""

    @property
    def segment_names(self) -> list[str]:
        return [f"segment{i}" for i in range(1, self.segments + 1)]

    @property
    def marker_names(self) -> list[str]:
        return [f"M{i}" for i in range(1, self.markers + 1)]

    def sensor_names(self, segment: int) -> list[str]:
        """Return the sensor names of a segment; segments are numbered from 0."""
        first = segment * self.sensors + 1
        return [f"S{number}" for number in range(first, first + self.sensors)]

    def rig(self) -> Rig:
        """Return the rig, with ports that are never opened."""
        table: dict[str, Any] = {
            "rig": {"name": "growth", "output_rate_hz": NS_PER_S / PERIOD_NS},
            "chain": {
                "joints": [f"joint{i}" for i in range(1, self.segments + 2)],
                "segments": self.segment_names,
            },
            "imu": [
                {
                    "id": sensor,
                    "segment": segment,
                    "driver": "xbus",
                    "port": f"/dev/{sensor}",
                    "baud": 921_600,
                    "rate_hz": NS_PER_S / PERIOD_NS,
                }
                for i, segment in enumerate(self.segment_names)
                for sensor in self.sensor_names(i)
            ],
        }
        if self.markers:
            markers = {self.segment_names[0]: self.marker_names}
            server = {"driver": "natnet", "server": "127.0.0.1", "up_axis": "z"}
            table["mocap"] = server | {"markers": markers}
        return parse_rig(table)

    def calibration(self, chain: Chain) -> Calibration:
        """Return a calibration whose sensors are aligned with their segments."""
        origin = (0.0, 0.0, 0.0)
        clusters = {}
        if self.markers:
            template = tuple(_template(i) for i in range(self.markers))
            stored = StoredCluster(tuple(self.marker_names), None, template, origin, UPRIGHT)
            clusters[chain.segments[0]] = stored
        paired = self.sensors == 2 and self.segments > 1
        return Calibration(
            method="anchored",
            joints=chain.joints,
            segments=chain.segments,
            chain_sensors=chain.sensors,
            sensor={
                name: SensorCalibration(UPRIGHT, UPRIGHT)
                for group in chain.sensors
                for name in group
            },
            segment={
                name: SegmentCalibration(UPRIGHT, 0.4, 0.01, _models(chain, i) if paired else {})
                for i, name in enumerate(chain.segments)
            },
            joint={name: JointCalibration(None, None, "unknown") for name in chain.joints},
            clusters=clusters,
            links=tuple(_links(chain)) if paired else (),
        )

    def opening(self) -> list[ChunkArrived]:
        """Return the messages that a motion-capture server sends before its first frame."""
        if not self.markers:
            return []
        words = encode(_SERVER), encode(model_definition(self._bodies(), BITSTREAM), BITSTREAM)
        return [ChunkArrived("mocap", Chunk(BEGIN_NS, word)) for word in words]

    def frame(self, number: int) -> list[ChunkArrived]:
        """Return the chunks of one frame in order of arrival."""
        exposed_ns = BEGIN_NS + number * PERIOD_NS
        events: list[ChunkArrived] = []
        for i in range(self.segments):
            data = xbus_message(number, number * PERIOD_NS // TICK_NS, swing(i, number))
            for name in self.sensor_names(i):
                at_ns = exposed_ns + STAGGER_NS * len(events)
                events.append(ChunkArrived(name, Chunk(at_ns, data)))
        if self.markers:
            data = self._camera_frame(number)
            events.append(ChunkArrived("mocap", Chunk(exposed_ns + CAMERA_DELAY_NS, data)))
        return events

    def _bodies(self) -> tuple[RigidBodyAsset, ...]:
        return (RigidBodyAsset("Segment", tuple(self.marker_names), 1),)

    def _camera_frame(self, number: int) -> bytes:
        q = swing(0, number)
        markers = {name: rotate_one(q, _template(i)) for i, name in enumerate(self.marker_names)}
        ticks = number * PERIOD_NS // 100
        stamps = FrameStamps(number, 0.0, ticks, ticks + 46_000, ticks + 60_000, 0)
        stage = NatNetFrameBuilder(self._bodies(), "z", "missing")
        return encode(stage.frame(stamps, markers, {"Segment": ((0.0, 0.0, 0.0), q)}), BITSTREAM)


def swing(segment: int, number: int) -> Quaternion:
    """Return the orientation of a segment, which rotates about x, with small sensor noise."""
    t_s = number * PERIOD_NS / NS_PER_S
    half = 0.5 * SWING * sin(2.0 * pi * SWING_HZ * t_s + segment) + 1e-5 * (number * 7919 % 97)
    return cos(half), sin(half), 0.0, 0.0


def _template(marker: int) -> Vector:
    """Return a marker position on a helix about the segment, m, distant from all others."""
    angle = 2.4 * marker
    return 0.06 * cos(angle), 0.06 * sin(angle), 0.3 * (marker * 0.618 % 1.0) - 0.15


@cache
def _wearer() -> Calibration:
    """Return the calibration of a subject with two sensors on each of two segments."""
    return fitted(bench_rig())


def _models(chain: Chain, segment: int) -> dict[str, Any]:
    """Return the subject's thigh models for the sensors of a segment and its neighbour."""
    names = dict(zip(("S1", "S2"), chain.sensors[segment], strict=True))
    names |= dict(zip(("S3", "S4"), neighbor(chain, segment), strict=True))
    return {
        "|".join(
            "+".join(names[sensor] for sensor in part.split("+") if sensor)
            for part in key.split("|")
        ): model
        for key, model in _wearer().segment["thigh"].models.items()
    }


def _links(chain: Chain) -> list[SensorLink]:
    """Return the subject's sensor links for each segment and the next distal segment."""
    found: dict[tuple[str, str], SensorLink] = {}
    for segment in range(len(chain.segments) - 1):
        names = dict(
            zip(
                ("S1", "S2", "S3", "S4"),
                (*chain.sensors[segment], *chain.sensors[segment + 1]),
                strict=True,
            )
        )
        for link in _wearer().links:
            a, b = names[link.a], names[link.b]
            near = tuple(names[name] for name in link.near)
            found.setdefault((a, b), replace(link, a=a, b=b, near=near))
    return [*found.values()]
