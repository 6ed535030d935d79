"""A Vicon decoder for tests, two rigid objects, and functions that return their frames."""

from __future__ import annotations

from typing import Any

from jointfit_daemon.model import Chunk, Decoded, DeviceEvent, MocapFrame
from jointfit_drivers.vicon import ViconDecoder, ViconSettings
from jointfit_protocols import vicon
from jointfit_protocols.vicon import ObjectId

UNTURNED = (1.0, 0, 0, 0, 1, 0, 0, 0, 1)
PERIOD = 1_350_000
"""Period of the frames at 100 Hz, ticks."""


def prop(number: int, name: str, *markers: str) -> vicon.SubjectInfo:
    named = tuple(vicon.MarkerInfo(n, marker) for n, marker in enumerate(markers, 1))
    return vicon.SubjectInfo(number, name, (vicon.SegmentInfo(0, 1, name),), named)


THIGH, SHANK = prop(1, "Thigh", "T1", "T2"), prop(2, "Shank", "S1")


def static(*objects: vicon.Object) -> bytes:
    found = objects or (vicon.StreamInfo(PERIOD), THIGH, SHANK)
    return vicon.encode(*found, vicon.Contents((), frozenset()))


def segments(
    subject: int, x: float, y: float, z: float, rotation: tuple[float, ...] = UNTURNED
) -> vicon.Segments:
    pose = vicon.SegmentPose(1, (x, y, z), rotation)
    return vicon.Segments(ObjectId.GLOBAL_SEGMENTS, subject, (pose,))


def recon(subject: int, marker: int, x: float, y: float, z: float) -> vicon.LabeledRecon:
    return vicon.LabeledRecon(subject, marker, 7.0, x, y, z)


def frame(number: int, *objects: vicon.Object, hardware: int | None = None) -> bytes:
    found = objects or (
        segments(1, 100, 200, 300),
        vicon.LabeledRecons((recon(1, 1, 1, 2, 3), recon(2, 1, 4, 5, 6))),
    )
    count = vicon.HardwareFrame(number + 1000 if hardware is None else hardware)
    unchanged = frozenset((1, 2, 37, 40))
    return vicon.encode(vicon.FrameInfo(number), count, *found, vicon.Contents((), unchanged))


class ViconFeeder:
    """A decoder and its events."""

    def __init__(self, **settings: Any) -> None:
        table = {"driver": "vicon", "server": "x", **settings}
        self.decoder = ViconDecoder(ViconSettings.model_validate(table))
        self.events: list[Decoded] = []

    def __call__(self, *packets: bytes, t_ns: int = 10**9) -> list[Decoded]:
        out = [item for packet in packets for item in self.decoder.feed(Chunk(t_ns, packet))]
        self.events += out
        return out

    def frames(self, *packets: bytes, t_ns: int = 10**9) -> list[MocapFrame]:
        return [item for item in self(*packets, t_ns=t_ns) if isinstance(item, MocapFrame)]

    def texts(self, kind: str) -> list[str]:
        return [e.text for e in self.events if isinstance(e, DeviceEvent) and e.kind == kind]


def ready(*objects: vicon.Object, **settings: Any) -> ViconFeeder:
    feeder = ViconFeeder(**settings)
    feeder(static(*objects))
    return feeder
