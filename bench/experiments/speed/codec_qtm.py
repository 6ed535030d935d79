"""QTM and Vicon: CPU time of codec and decoder per frame; QTM is compared with `qtm-rt`."""

from __future__ import annotations

import gc
import statistics
from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING

from bench.framework.measurement import cpu_s, per_item, repeats, speed_experiment, timed_result
from jointfit_daemon.driver import find_driver
from jointfit_daemon.model import Chunk, MocapFrame
from jointfit_protocols import qtm, vicon
from jointfit_protocols.qtm import ComponentType
from jointfit_protocols.vicon import ObjectId
from jointfit_simulators.body import CLUSTERS

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result

N = 500
PERIOD_NS = 8_333_333
BODIES = tuple(part.capitalize() for part in CLUSTERS)
MARKERS = tuple(name for names in CLUSTERS.values() for name in names)
SIZE = f"{len(BODIES)} bodies, {len(MARKERS)} markers"
TURN = (0.28, 0.96, 0.0, -0.96, 0.28, 0.0, 0.0, 0.0, 1.0)


def _qtm_frame(k: int) -> bytes:
    bodies = tuple((100.0 + k, 200.0, 300.0, *TURN, 0.5) for _ in BODIES)
    markers = tuple((100.0 + k, 200.0, 300.0, 0.5) for _ in MARKERS)
    ticks = k * PERIOD_NS // 100
    parts = (
        qtm.ItemsComponent(ComponentType.BODIES_RESIDUAL, 0, 0, bodies),
        qtm.ItemsComponent(ComponentType.MARKERS_RESIDUAL, 0, 0, markers),
        qtm.TimecodeComponent((qtm.QtmTimecode(2, ticks >> 32, ticks & 0xFFFFFFFF),)),
    )
    return qtm.encode(qtm.DataFrame(k * PERIOD_NS // 1000, k, parts))


def _qtm_settings() -> bytes:
    labels = "".join(f"<Label><Name>{name}</Name></Label>" for name in MARKERS)
    bodies = "".join(f"<Body><Name>{name}</Name></Body>" for name in BODIES)
    return qtm.encode(
        qtm.SettingsReply(
            "<QTM_Parameters_Ver_1.25><General><External_Timestamp><Enabled>true</Enabled>"
            "<Type>Camera time</Type></External_Timestamp></General><The_3D><AxisUpwards>+Z"
            f"</AxisUpwards>{labels}</The_3D><The_6D>{bodies}</The_6D></QTM_Parameters_Ver_1.25>"
        )
    )


QTM_FRAMES = [_qtm_frame(k) for k in range(1, N + 1)]


def _decoding(
    driver_name: str, opening: bytes, frames: list[bytes]
) -> Callable[[], Callable[[], object]]:
    """Return a function that prepares a decoder run; check that each frame yields a result."""
    driver = find_driver(driver_name)
    settings = driver.Settings(driver=driver_name, server="127.0.0.1")
    chunks = [Chunk(k * PERIOD_NS, data) for k, data in enumerate(frames, 1)]

    def prepare() -> Callable[[], object]:
        decoder = driver(settings).decoder()
        decoder.feed(Chunk(0, opening))
        return lambda: [item for chunk in chunks for item in decoder.feed(chunk)]

    found = prepare()()
    assert isinstance(found, list)
    assert sum(isinstance(item, MocapFrame) for item in found) == N
    return prepare


def _qtm_codec() -> Callable[[], object]:
    return lambda: [qtm.decode(data) for data in QTM_FRAMES]


def _peer() -> Callable[[], object]:
    """Return a function that reads the same components with the vendor's package."""
    packet_of = import_module("qtm_rt.packet").QRTPacket  # tests use this package as a reference
    payloads = [data[qtm.HEADER.size :] for data in QTM_FRAMES]

    def read() -> None:
        for data in payloads:
            packet = packet_of(data)
            assert len(packet.get_6d_residual()[1]) == len(BODIES)
            assert len(packet.get_3d_markers_residual()[1]) == len(MARKERS)

    return read


def qtm_rows(quick: bool) -> list[Result]:
    whole = _decoding("qtm", _qtm_settings(), QTM_FRAMES)
    ours: list[float] = []
    theirs: list[float] = []
    for _ in range(repeats(quick)):  # both libraries alternate
        for prepare, took in ((_qtm_codec, ours), (_peer, theirs)):
            work = prepare()
            gc.collect()
            took.append(cpu_s(work) / N)
    ratio = statistics.median(a / b for a, b in zip(ours, theirs, strict=True))
    peer_us = round(statistics.median(theirs) * 1e6, 2)
    return [
        per_item("qtm: codec, one frame", _qtm_codec, items=N, goal_us=30, quick=quick, note=SIZE),
        per_item("qtm: bytes to MocapFrame", whole, items=N, goal_us=150, quick=quick),
        timed_result("qtm: the package qtm-rt, one frame", peer_us, "µs"),
        timed_result("qtm: time ratio to the package", round(ratio, 4), "", 0.5, 1.0),
    ]


def _vicon_frame(k: int) -> bytes:
    rotation = (0.28, -0.96, 0.0, 0.96, 0.28, 0.0, 0.0, 0.0, 1.0)
    pose = (vicon.SegmentPose(1, (100.0 + k, 200.0, 300.0), rotation),)
    recons = tuple(
        vicon.LabeledRecon(subject, marker, 7.0, 100.0 + k, 200.0, 300.0)
        for subject, names in enumerate(CLUSTERS.values(), 1)
        for marker in range(1, len(names) + 1)
    )
    return vicon.encode(
        vicon.FrameInfo(k),
        vicon.HardwareFrame(k),
        vicon.LatencyInfo((("Processing", 0.003), ("Streaming", 0.001))),
        vicon.LabeledRecons(recons),
        *(
            vicon.Segments(ObjectId.GLOBAL_SEGMENTS, subject, pose)
            for subject in range(1, len(BODIES) + 1)
        ),
        vicon.Contents((), frozenset((1, 2))),
    )


def _vicon_subjects() -> bytes:
    subjects = [
        vicon.SubjectInfo(
            number,
            part.capitalize(),
            (vicon.SegmentInfo(0, 1, part.capitalize()),),
            tuple(vicon.MarkerInfo(n, name) for n, name in enumerate(names, 1)),
        )
        for number, (part, names) in enumerate(CLUSTERS.items(), 1)
    ]
    return vicon.encode(vicon.StreamInfo(1_125_000), *subjects)


def vicon_rows(quick: bool) -> list[Result]:
    frames = [_vicon_frame(k) for k in range(1, N + 1)]
    whole = _decoding("vicon", _vicon_subjects(), frames)

    def codec() -> Callable[[], object]:
        return lambda: [vicon.decode(data) for data in frames]

    return [
        per_item("vicon: codec, one frame", codec, items=N, goal_us=60, quick=quick, note=SIZE),
        per_item("vicon: bytes to MocapFrame", whole, items=N, goal_us=150, quick=quick),
    ]


EXPERIMENTS = (
    replace(
        speed_experiment("qtm-codec", "QTM: codec and decoder, with a peer", qtm_rows),
        packages=("qtm_rt",),
    ),
    speed_experiment("vicon-codec", "Vicon: codec and decoder", vicon_rows),
)
