"""Core: exchanged marker labels of a rig without chain model, from camera bytes to notices."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from jointfit_daemon.calibration.phases import fit_calibration
from jointfit_daemon.config import parse_rig
from jointfit_daemon.model import Chunk, OpticalState
from jointfit_daemon.pipeline.events import (
    ChunkArrived,
    Configured,
    Notice,
    NoticeKind,
    SourceOpened,
)
from jointfit_protocols.natnet import (
    FrameOfData,
    MarkerSet,
    MarkerSetDescription,
    ModelDefinition,
    ServerInfo,
)
from jointfit_protocols.natnet import encode as encode_natnet
from tests.calibration.synthetic_limb import (
    CHAIN,
    MARKERS,
    SETTINGS,
    Imperfections,
    Subject,
    motion,
    record,
    static_and_functional,
)
from tests.limb_model.clusters_of_limb import LABELS, cycled
from tests.pipeline.core_feed import BEGIN_NS, DELAYS_NS, PERIOD_NS, SENSORS, Bench, chunk, table

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.pipeline.events import Event

VERSION = (3, 0)
SUBJECT = Subject(11, flaws=Imperfections(skin_m=0.004))
SECONDS = 9.0


@cache
def calibration() -> Calibration:
    static, functional, _ = static_and_functional(SUBJECT, 15.0)
    return fit_calibration(static, functional, None, replace(SETTINGS, method="mean"), CHAIN)


@cache
def movement() -> Array:
    """Return markers at 100 Hz, m, shape (n, M, 3)."""
    optical = record(SUBJECT, motion(SUBJECT, SECONDS, 400.0), 3, sensors=False).optical
    assert optical is not None
    rows = (np.arange(0.0, SECONDS - 0.1, 0.01) * 120).astype(int)
    return np.asarray(optical.positions[rows])


def rig_table(**chain: Any) -> dict[str, Any]:
    whole = table()
    whole["chain"] |= {"proximal": "pelvis", "distal": "foot"} | chain
    whole["mocap"] = {
        "driver": "natnet", "server": "127.0.0.1", "up_axis": "z",
        "markers": {part: list(names) for part, names in MARKERS.items()},
    }  # fmt: skip
    return whole


def camera_events(positions: Array) -> list[Event]:
    info = ServerInfo("Motive", (2, 1, 0, 0), (3, 0, 0, 0), 10_000_000)
    model = ModelDefinition((MarkerSetDescription("Limb", LABELS),))
    events = [
        ChunkArrived("mocap", Chunk(BEGIN_NS, encode_natnet(m, VERSION))) for m in (info, model)
    ]
    for k, points in enumerate(positions):
        ticks = k * 100_000
        sets = (MarkerSet("Limb", tuple(map(tuple, points.tolist()))),)
        data = encode_natnet(
            FrameOfData(k, 0.0, ticks, ticks + 1, ticks + 2, marker_sets=sets), VERSION
        )
        t_ns = BEGIN_NS + k * PERIOD_NS + DELAYS_NS["mocap"]
        events.append(ChunkArrived("mocap", Chunk(t_ns, data)))
    return list(events)


def run(positions: Array) -> Bench:
    """Return a core that has processed cameras and sensors."""
    rig = parse_rig(rig_table())
    bench = Bench()
    bench.feed([Configured(BEGIN_NS, rig, calibration())])
    bench.feed(SourceOpened(BEGIN_NS, source.id) for source in rig.sources)
    cameras = camera_events(positions)
    sensors = [chunk(name, k) for k in range(len(positions)) for name in SENSORS]
    events = [*cameras, *sensors]
    events.sort(key=lambda event: event.chunk.t_ns if isinstance(event, ChunkArrived) else 0)
    bench.feed(events)
    return bench


@cache
def correct() -> Bench:
    return run(movement())


def marker_notices(bench: Bench) -> list[Notice]:
    return [one for one in bench.out if isinstance(one, Notice) and one.kind is NoticeKind.MARKER]


def optical(bench: Bench, after_s: float, before_s: float) -> list[OpticalState]:
    return [
        one
        for one in bench.out
        if isinstance(one, OpticalState) and after_s < (one.t_ns - BEGIN_NS) / 1e9 < before_s
    ]


@pytest.mark.parametrize("labels", [("thigh0", "thigh2"), ("thigh3", "shank0")], ids="-".join)
def test_the_core_names_the_markers_publishes_no_wrong_pose_and_recovers(
    labels: tuple[str, ...],
) -> None:
    positions = movement().copy()
    positions[:500] = cycled(positions[:500], *labels)
    bench = run(positions)
    begin, end = marker_notices(bench)
    assert begin.data["state"] == "exchanged"
    assert end.data["state"] == "ok"
    assert begin.data["markers"] == list(labels)

    # Exchanged markers are hidden. With two of its four markers the thigh has no pose, and with
    # three of them it has a pose.
    during, after = optical(bench, 3.0, 5.0), optical(bench, 7.5, 8.5)
    assert len(during) > 20
    healthy = {one.t_ns: one for one in optical(correct(), 3.0, 5.0)}
    for state in during:
        thigh, shank = state.segments
        assert shank.q_world_segment is not None
        assert (thigh.q_world_segment is None) == (labels == ("thigh0", "thigh2"))
        knee, expected = state.joints[1].angles, healthy[state.t_ns].joints[1].angles
        if knee is not None:
            assert expected is not None
            assert knee.flexion == pytest.approx(expected.flexion, abs=np.radians(5.0))
    assert all(one.q_world_segment is not None for state in after for one in state.segments)


def test_correct_labels_have_no_notice() -> None:
    bench = correct()
    assert marker_notices(bench) == []
    states = optical(bench, 1.0, 8.0)
    assert len(states) > 100
    assert all(one.q_world_segment is not None for state in states for one in state.segments)
