"""Collection of training frames for online learning: pairs of sensor and mocap frames.

Ten frames per second are examined. A frame is retained if all sensors and markers are present, the
clocks are synchronized, and no sensor fault is flagged. While the posture of the subject does
not change, one frame per second is retained.

Invariant: the size of the collection is limited, and no frames are paired across a restart of a
clock.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.calibration import OnlineFrames
from jointfit_daemon.kinematics.rotation_scalar import interpolate_one, multiply_one
from jointfit_daemon.model import FrameFlag
from jointfit_daemon.pipeline.online_learning._learning_state import LearningMonitor, not_visible

if TYPE_CHECKING:
    from collections.abc import Collection

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import Chain, MocapFrame, MocapLayout, Quaternion
    from jointfit_daemon.pipeline.events import Notice
    from jointfit_daemon.pipeline.health import LearningHealth
    from jointfit_daemon.timing.alignment import AlignedFrame

INTERVAL_NS = 100_000_000
"""Time between examined frames, ns."""
POSTURE_NS = 1_000_000_000
"""Time between retained frames of the same posture, ns."""
POSTURE_COSINE = 0.99985
"""Cosine of half of 2°. If no segment has rotated by 2° since the last retained frame, the posture
is the same."""
MAX_GAP_NS = 60_000_000
"""Longest time between two sensor frames for interpolation, ns."""
MAX_FRAMES = 3000
"""Largest number of retained frames. The oldest frames are dropped."""
MIN_FRAMES = 600
"""Number of frames required for a refit, equal to one minute of movement."""
REFIT_NS = 180_000_000_000
"""Shortest time between two refits, ns. The first refit starts when this time has passed since
`MIN_FRAMES` frames were retained."""
_FAULTS = {
    FrameFlag.STUCK: "sensor repeats its value",
    FrameFlag.SLIPPED: "sensor slipped",
    FrameFlag.PAIR_DISAGREES: "sensors contradict each other",
    FrameFlag.HEADING_DISAGREES: "headings contradict each other",
    FrameFlag.ONE_SENSOR: "one working sensor only",
    FrameFlag.HELD: "no data of the sensors",
    FrameFlag.LOST: "no data of the sensors",
}
"""Flags that exclude a frame from training, and the texts that explain them."""
_RECENT, _WAITING = 64, 16


class _TrainingFrame(NamedTuple):
    sensors: list[Quaternion]
    """Segment orientation q_optical_segment computed from each sensor, in the order of the
    chain."""
    mocap: list[Array]
    """For each segment, its k markers, m, shape (k, 3), or its rigid-body orientation, shape
    (4,)."""


class OnlineFrameCollector:
    """Collects frames for ``calibration.phases.refit_models``.

    Parameters
    ----------
    chain : Chain
        The limb.
    calibration : Calibration or None
        The current calibration. No frame is collected without a calibration, or if the calibration
        contains no movement data or lacks the marker clusters of a segment.
    wanted : bool
        Value of ``learn_online`` in rig.toml.
    """

    def __init__(self, chain: Chain, calibration: Calibration | None, *, wanted: bool) -> None:
        off = _exclusion_reason(chain, calibration, wanted=wanted)
        self.active, self._monitor = off is None, LearningMonitor(off)
        self._chain = chain
        self._sensors = [sensor for group in chain.sensors for sensor in group]
        self._firsts = [self._sensors.index(group[0]) for group in chain.sensors if group]
        self._alignments: list[tuple[Quaternion, Quaternion]] = []
        self._clusters: list[tuple[tuple[str, ...], str | None]] = []
        if calibration is not None and self.active:
            used = [calibration.sensor[sensor] for sensor in self._sensors]
            self._alignments = [(item.q_optical_world, item.q_sensor_segment) for item in used]
            clusters = [calibration.clusters[name] for name in chain.segments]
            self._clusters = [(cluster.markers, cluster.body) for cluster in clusters]
        self._layout: MocapLayout | None = None
        self._columns: list[list[int]] | None = None
        self._missing: list[str] = []
        self._epoch: int | None = None
        self._waiting_since_ns: int | None = None
        self._clear()

    def _clear(self) -> None:
        self._frames: deque[AlignedFrame] = deque(maxlen=_RECENT)
        self._waiting: deque[tuple[int, list[Array]]] = deque(maxlen=_WAITING)
        self._kept: deque[_TrainingFrame] = deque(maxlen=MAX_FRAMES)
        self._kept_ns = self._next_ns = 0
        self._last_ns: int | None = None

    def notices(self, now_ns: int) -> list[Notice]:
        """Return the notices about obstacles to learning that are due.

        Each notice is returned once.
        """
        return self._monitor.notices(now_ns)

    def health(self, now_ns: int) -> LearningHealth:
        """Return the state of online learning."""
        return self._monitor.health(now_ns, len(self._kept))

    # --- input -------------------------------------------------------------------------------

    def add_mocap(self, t_ns: int, frame: MocapFrame, epoch: int = 0) -> None:
        """Add one live mocap frame with a synchronized stamp."""
        if not self.active or t_ns < self._next_ns:
            return
        if frame.layout is not self._layout:
            self._layout = frame.layout

            # Find the columns of each cluster's markers or rigid body in the new layout.
            columns, missing = [], []
            for markers, body in self._clusters:
                known, names = (
                    (frame.layout.markers, markers)
                    if body is None
                    else (frame.layout.bodies, (body,))
                )
                missing += [name for name in names if name not in known]
                columns.append([known.index(name) for name in names if name in known])
            self._missing = list(dict.fromkeys(missing))
            self._columns = None if missing else columns
        if epoch != self._epoch:
            self._clear()
            self._epoch = epoch
        self._next_ns = t_ns + INTERVAL_NS
        if self._columns is None:
            reason = f"missing in the mocap stream: {', '.join(self._missing)}"
            self._monitor.add_obstacle(t_ns, reason)
            return

        mocap = [
            frame.markers[columns] if body is None else frame.body_orientations[columns[0]]
            for columns, (_, body) in zip(self._columns, self._clusters, strict=True)
        ]

        # Find the markers and bodies that are not visible. Usually all are visible.
        invisible = []
        for x, (markers, body) in zip(mocap, self._clusters, strict=True):
            if np.isfinite(x).all():
                continue
            if body is not None:
                invisible.append(body)
            else:
                visible = np.isfinite(x.sum(axis=1)).tolist()
                invisible += [n for n, seen in zip(markers, visible, strict=True) if not seen]
        invisible = list(dict.fromkeys(invisible))  # clusters may share markers
        if not invisible:
            self._waiting.append((t_ns, mocap))
            return
        in_view = any(np.isfinite(x).any() for x in mocap)
        self._monitor.add_obstacle(t_ns, not_visible(invisible), in_view=in_view)

    def add_frame(self, frame: AlignedFrame, flags: Collection[str]) -> None:
        """Add one sensor frame, and the flags of its limb state."""
        if not self.active:
            return
        if self._last_ns is not None and frame.t_ns < self._last_ns:
            self._clear()
        self._last_ns = frame.t_ns
        self._frames.append(frame)

        waiting = self._waiting
        while waiting and waiting[0][0] <= frame.t_ns:
            t_ns, mocap = waiting.popleft()
            places: dict[str, list[str]] = {}
            for flag in flags:
                kind, _, place = flag.partition(":")
                if kind in _FAULTS:
                    places.setdefault(_FAULTS[FrameFlag(kind)], []).append(place)
            if not places:
                self._pair(t_ns, mocap)
            else:
                listed = (f"{text} ({', '.join(names)})" for text, names in places.items())
                self._monitor.add_obstacle(t_ns, "; ".join(listed))

    def take_due(self, now_ns: int) -> OnlineFrames | None:
        """Return and remove the collected frames if a refit is due; return None otherwise."""
        if len(self._kept) < MIN_FRAMES:
            return None
        if self._waiting_since_ns is None or now_ns - self._waiting_since_ns < REFIT_NS:
            self._waiting_since_ns = self._waiting_since_ns or now_ns
            return None

        self._waiting_since_ns = now_ns
        kept, names = list(self._kept), self._chain.segments
        self._kept.clear()
        sensors = np.array([row.sensors for row in kept], dtype=np.float64)
        mocap = {
            name: np.stack([row.mocap[i] for row in kept]).astype(np.float64)
            for i, name in enumerate(names)
        }
        bodies = {n for n, (_, body) in zip(names, self._clusters, strict=True) if body}
        return OnlineFrames(
            {name: sensors[:, i] for i, name in enumerate(self._sensors)},
            {name: x for name, x in mocap.items() if name not in bodies},
            {name: x for name, x in mocap.items() if name in bodies},
        )

    # --- pairs -------------------------------------------------------------------------------

    def _pair(self, t_ns: int, mocap: list[Array]) -> None:
        """Pair a mocap frame with the sensor data of its instant; retain the pair if it is due."""
        after = None
        for before in reversed(self._frames):
            if before.t_ns <= t_ns:
                break
            after = before
        else:
            return
        if after is None:  # the newest sensor frame has the instant of the mocap frame
            after = before

        sensors = self._sensors_at(t_ns, before, after)
        if sensors is None:
            absent = [
                sensor
                for sensor in self._sensors
                if sensor not in before.orientations or sensor not in after.orientations
            ]
            reason = "sensor clocks are not synchronized yet"
            if absent:
                reason = f"no data from {absent[0]}"
            elif before.synced and after.synced:
                reason = "gaps in the data of the sensors"
            self._monitor.add_obstacle(t_ns, reason)
            return
        self._monitor.add_usable(t_ns)
        if self._kept and t_ns - self._kept_ns < POSTURE_NS:
            last = self._kept[-1].sensors
            if all(_abs_dot(sensors[i], last[i]) > POSTURE_COSINE for i in self._firsts):
                return
        self._kept.append(_TrainingFrame(sensors, mocap))
        self._kept_ns = t_ns

    def _sensors_at(
        self, t_ns: int, before: AlignedFrame, after: AlignedFrame
    ) -> list[Quaternion] | None:
        """Return the segment orientations from all sensors, interpolated between two frames.

        The result is None if data or synchronization is missing, or the frames are too far apart.
        """
        width = after.t_ns - before.t_ns
        if width > MAX_GAP_NS or not (before.synced and after.synced):
            return None
        share = (t_ns - before.t_ns) / width if width else 0.0
        sensors = []
        for sensor, (q_world, q_alignment) in zip(self._sensors, self._alignments, strict=True):
            first, second = before.orientations.get(sensor), after.orientations.get(sensor)
            if first is None or second is None:
                return None
            q = interpolate_one(first, second, share)
            sensors.append(multiply_one(multiply_one(q_world, q), q_alignment))
        return sensors


def _abs_dot(p: Quaternion, q: Quaternion) -> float:
    return abs(p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3])


def _exclusion_reason(chain: Chain, calibration: Calibration | None, *, wanted: bool) -> str | None:
    """Return the reason why this configuration excludes online learning; None if it does not."""
    if not wanted:
        return "learn_online is off in rig.toml"
    if calibration is None or not calibration.fits(chain):
        return "not calibrated"
    if not calibration.memory:
        return "the calibration holds no movement data: run the functional phase once"
    bare = [name for name in chain.segments if name not in calibration.clusters]
    return f"the calibration has no markers on {', '.join(bare)}" if bare else None
