"""A session with every kind of content."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from jointfit_daemon.session_data import (
    JointSeries,
    MarkerSeries,
    SegmentSeries,
    SensorSeries,
    SessionData,
    TimelineEvent,
)

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

START_NS = 1795250060351823457
RATE_HZ = 100.0
ROWS = 200


def turns(rows: int, seed: int) -> Array:
    """Return the quaternions of a smooth random rotation, of which three are unknown."""
    rng = np.random.default_rng(seed)
    q = Rotation.from_rotvec(np.cumsum(rng.normal(scale=0.02, size=(rows, 3)), axis=0))
    orientation = q.as_quat(scalar_first=True)
    orientation[20:23] = np.nan
    return orientation


def walking_session() -> SessionData:
    """Return a session with gaps, two clocks, uncertainty and events."""
    rng = np.random.default_rng(5)
    places = rng.normal(size=(ROWS, 3))
    t_s = 3.0 + np.arange(ROWS) / RATE_HZ
    # the second sensor has its own clock, and lost samples
    own_s = np.delete(3.0021 + np.arange(ROWS) / RATE_HZ, [50, 51])
    positions = rng.normal(size=(ROWS, 3, 3))
    positions[10:15, 1] = np.nan
    angle = np.sin(t_s)
    angle[7] = np.nan
    sd = np.full(ROWS, 0.02)
    return SessionData(
        "walk",
        START_NS,
        (
            SensorSeries("S1", "thigh", t_s, turns(ROWS, 1), rng.normal(size=(ROWS, 3))),
            SensorSeries("S2", "shank", own_s, turns(ROWS - 2, 2)),
        ),
        MarkerSeries(("T1", "T2", "Knie-ü"), t_s, positions),
        (SegmentSeries("thigh", t_s, turns(ROWS, 3), sd),),
        (JointSeries("knee", t_s, {"flexion": angle}, {"flexion": sd}, places),),
        events=(
            TimelineEvent(3.25, "mark", "", "heel strike"),
            TimelineEvent(4.5, "fault", "S1", "sensor slip"),
        ),
        description={"rig": "bench-1"},
    )  # fmt: skip
