"""OpenSim and ezc3d read the markers of a recorded NatNet server from the exported files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from typer.testing import CliRunner

from jointfit_daemon.config import parse_rig
from jointfit_daemon.model import Chunk
from jointfit_daemon.outputs.recording import Recorder
from jointfit_daemon.pipeline.events import ChunkArrived, Configured, SourceOpened
from jointfit_daemon.tools.__main__ import app
from jointfit_protocols.natnet import ServerInfo, encode
from jointfit_simulators.devices._natnet_frames import (
    FrameStamps,
    NatNetFrameBuilder,
    RigidBodyAsset,
    model_definition,
)
from tests.pipeline import core_feed
from tests.pipeline.core_feed import BEGIN_NS, PERIOD_NS
from tests.reprocessing.recorded_run import RecordingBench

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array

VERSION = (4, 1)
FRAMES = 300
HIDDEN_FROM, HIDDEN_TO = 100, 130
"""Frames in which the marker T2 is occluded."""
BODIES = (
    RigidBodyAsset("Thigh", ("T1", "T2", "T3"), 1),
    RigidBodyAsset("Shank", ("C1", "C2", "C3"), 2),
)
PLACES = {
    "T1": (0.1, 0.2, 0.9), "T2": (0.15, 0.2, 0.8), "T3": (0.1, 0.28, 0.7),
    "C1": (0.12, 0.2, 0.4), "C2": (0.1, 0.25, 0.3), "C3": (0.08, 0.2, 0.2),
}  # fmt: skip
"""Positions of the markers at the first frame: forward, left and up, m."""
VELOCITY = (0.3, -0.2, 0.1)
"""Velocity of all markers, m/s."""


def record_cameras(folder: Path) -> Path:
    """Record the processing of the datagrams of a server; return the path of the recording."""
    table = core_feed.table()
    table["mocap"] = {
        "driver": "natnet",
        "server": "127.0.0.1",
        "markers": {body.name.lower(): list(body.markers) for body in BODIES},
    }
    rig, bench = parse_rig(table), RecordingBench(recorder=Recorder(folder, "r"))
    bench.feed([Configured(BEGIN_NS, rig, None)])
    bench.feed([SourceOpened(BEGIN_NS, source.id) for source in rig.sources])

    server = ServerInfo("Motive", (3, 1, 0, 0), (*VERSION, 0, 0), 10_000_000)
    builder = NatNetFrameBuilder(BODIES, "y", "missing")
    datagrams = [encode(server, VERSION), encode(model_definition(BODIES, VERSION), VERSION)]
    for number in range(FRAMES):
        moved = np.array(VELOCITY) * number * PERIOD_NS * 1e-9
        markers: dict[str, Any] = {
            name: tuple((np.array(at) + moved).tolist()) for name, at in PLACES.items()
        }
        if HIDDEN_FROM <= number < HIDDEN_TO:
            markers["T2"] = None
        ticks = number * PERIOD_NS // 100
        stamps = FrameStamps(number, 0.0, ticks, ticks + 1, ticks + 2, 0)
        datagrams.append(encode(builder.frame(stamps, markers, {}), VERSION))
    for number, datagram in enumerate(datagrams):
        at_ns = BEGIN_NS + max(0, number - 2) * PERIOD_NS + core_feed.DELAYS_NS["mocap"]
        bench.feed([ChunkArrived("mocap", Chunk(at_ns, datagram))])
    bench.recorder.close()
    (path,) = folder.iterdir()
    return path


def read_trc(path: Path) -> tuple[list[str], Array, Array]:
    """Return labels, times (s) and positions (m, z up) that OpenSim reads from a TRC file."""
    opensim: Any = pytest.importorskip("opensim")
    table = opensim.TimeSeriesTableVec3(str(path))
    flat = table.flatten()
    columns = [flat.getDependentColumnAtIndex(k).to_numpy() for k in range(flat.getNumColumns())]
    y_up = np.array(columns).T.reshape(len(columns[0]), -1, 3)
    return [*table.getColumnLabels()], np.array(table.getIndependentColumn()), y_up[..., [2, 0, 1]]


def read_c3d(path: Path) -> tuple[list[str], Array, Array]:
    """Return labels, times (s) and positions (m, z up) that ezc3d reads from a C3D file."""
    ezc3d: Any = pytest.importorskip("ezc3d")
    file = ezc3d.c3d(str(path))
    point = file["parameters"]["POINT"]
    assert point["UNITS"]["value"] == ["mm"]
    positions = file["data"]["points"][:3].transpose(2, 1, 0) / 1000.0
    t_s = np.arange(len(positions)) / point["RATE"]["value"][0]
    return point["LABELS"]["value"], t_s, positions


@pytest.mark.parametrize(("to", "read"), [("trc", read_trc), ("c3d", read_c3d)])
def test_markers_of_a_recorded_server_are_exported_with_their_places_and_gaps(
    to: str, read: Any, tmp_path: Path
) -> None:
    recording = record_cameras(tmp_path / "recording")
    ended = CliRunner().invoke(app, ["export", str(recording), "--to", to, "--out", str(tmp_path)])
    assert ended.exit_code == 0, ended.output

    labels, t_s, positions = read(*tmp_path.glob(f"*.{to}"))
    assert sorted(labels) == sorted(PLACES)
    assert len(t_s) == pytest.approx(FRAMES, abs=3)
    assert np.diff(t_s) == pytest.approx(0.01, abs=1e-5)
    offset_s = (positions[0, labels.index("T1"), 0] - PLACES["T1"][0]) / VELOCITY[0] - t_s[0]
    assert abs(offset_s) < 0.05
    for label in labels:
        found = positions[:, labels.index(label)]
        expected = np.array(PLACES[label]) + np.outer(t_s + offset_s, VELOCITY)
        seen = ~np.isnan(found).any(axis=1)
        assert found[seen] == pytest.approx(expected[seen], abs=2e-4)
        hidden = HIDDEN_TO - HIDDEN_FROM if label == "T2" else 0
        assert np.count_nonzero(~seen) == pytest.approx(hidden, abs=2)
