"""What the cameras teach while it runs: pairs of sensor and camera frames, kept for a refit.

Law: pure and bounded; a frame costs a look at two instants, ten a second are worked on. Kept are
frames in which everything is whole, in order and moving; a posture held is kept once a second.
What is kept is thrown away when cameras or clocks begin anew: nothing is paired across a gap.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.calibration import Fresh
from jointfit_daemon.kinematics.rotation_scalar import interpolate_one, multiply_one
from jointfit_daemon.pipeline.online_learning._learning_state import LearningWatch, hidden

if TYPE_CHECKING:
    from collections.abc import Collection

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import Chain, MocapFrame, MocapLayout, Quaternion
    from jointfit_daemon.pipeline.events import Notice
    from jointfit_daemon.timing.alignment import AlignedFrame

EVERY_NS = 100_000_000
"""Between frames that are looked at."""
STILL_NS = 1_000_000_000
STILL_DOT = 0.99985
"""Cosine of half of 2°: a segment that turned by less since the last frame kept is still."""
GAP_NS = 60_000_000
"""Longest time between two aligned frames that is interpolated."""
MOST, ENOUGH = 3000, 600
"""Frames kept: the newest; and how many ask for a refit, a minute of movement."""
REST_NS = 180_000_000_000
"""Between two refits, and before the first one once there are frames enough."""
_DOUBTS = (
    "stuck:", "slipped:", "pair_disagrees:", "heading_disagrees:", "one_sensor:", "held:", "lost:",
)  # fmt: skip
_RECENT, _WAITING = 64, 16


class _Kept(NamedTuple):
    """One frame."""

    sensors: list[Quaternion]
    """q_optical_segment by each sensor, in the order of the chain."""
    seen: list[Array]
    """Per segment its markers, shape (k, 3), or its rigid body's orientation, shape (4,)."""


class OnlineLearner:
    """Collects frames for ``calibration.online_fit``.

    Parameters
    ----------
    chain : Chain
        The limb.
    calibration : Calibration or None
        In force. Nothing is collected without one, or with one that has no memory of its movement,
        or whose clusters do not cover all segments.
    wanted : bool
        ``learn_online`` of rig.toml.
    """

    def __init__(self, chain: Chain, calibration: Calibration | None, *, wanted: bool) -> None:
        off = _off(chain, calibration, wanted=wanted)
        self.active, self._watch = off is None, LearningWatch(off)
        self._chain = chain
        self._sensors = [sensor for group in chain.sensors for sensor in group]
        self._firsts = [self._sensors.index(group[0]) for group in chain.sensors if group]
        self._mounts: list[tuple[Quaternion, Quaternion]] = []
        self._clusters: list[tuple[tuple[str, ...], str | None]] = []
        if calibration is not None and self.active:
            used = [calibration.sensor[sensor] for sensor in self._sensors]
            self._mounts = [(item.q_optical_world, item.q_sensor_segment) for item in used]
            clusters = [calibration.clusters[name] for name in chain.segments]
            self._clusters = [(cluster.markers, cluster.body) for cluster in clusters]
        self._layout: MocapLayout | None = None
        self._columns: list[list[int]] | None = None
        self._unnamed: list[str] = []
        self._epoch: int | None = None
        self._rest_from_ns: int | None = None
        self._begin_again()

    def _begin_again(self) -> None:
        self._frames: deque[AlignedFrame] = deque(maxlen=_RECENT)
        self._waiting: deque[tuple[int, list[Array]]] = deque(maxlen=_WAITING)
        self._kept: deque[_Kept] = deque(maxlen=MOST)
        self._kept_ns = self._next_ns = 0
        self._last_ns: int | None = None

    def notices(self, now_ns: int) -> list[Notice]:
        """Return what is worth telling of what keeps the limb from learning, each change once."""
        return self._watch.notices(now_ns)

    def health(self, now_ns: int) -> dict[str, object]:
        """Return whether anything is learned, and what keeps it from that, JSON-able."""
        return self._watch.health(now_ns, len(self._kept))

    @property
    def kept(self) -> int:
        """How many frames wait for a refit."""
        return len(self._kept)

    # --- in ----------------------------------------------------------------------------------

    def add_mocap(self, t_ns: int, frame: MocapFrame, epoch: int = 0) -> None:
        """Take one live camera frame whose stamp is mapped."""
        if not self.active or t_ns < self._next_ns:
            return
        if frame.layout is not self._layout:
            self._layout = frame.layout
            self._unnamed = self._missing(frame.layout)
            self._columns = None if self._unnamed else self._found(frame.layout)
        if epoch != self._epoch:
            self._begin_again()
            self._epoch = epoch
        self._next_ns = t_ns + EVERY_NS
        if self._columns is None:
            self._watch.hindered(t_ns, f"not in the stream: {', '.join(self._unnamed)}")
            return
        seen = self._seen(frame, self._columns)
        unseen = self._unseen(seen)
        if not unseen:
            self._waiting.append((t_ns, seen))
            return
        in_view = any(np.isfinite(x).any() for x in seen)
        self._watch.hindered(t_ns, hidden(unseen), in_view=in_view)

    def add_frame(self, frame: AlignedFrame, flags: Collection[str]) -> None:
        """Take one frame of the sensors, and what fusion said of it."""
        if not self.active:
            return
        if self._last_ns is not None and frame.t_ns < self._last_ns:
            self._begin_again()
        self._last_ns = frame.t_ns
        self._frames.append(frame)
        waiting = self._waiting
        while waiting and waiting[0][0] <= frame.t_ns:
            t_ns, seen = waiting.popleft()
            doubts = [flag for flag in flags if flag.startswith(_DOUBTS)]
            if not doubts:
                self._pair(t_ns, seen)
            else:
                self._watch.hindered(t_ns, f"the sensors are in doubt: {', '.join(doubts)}")

    def due(self, now_ns: int) -> Fresh | None:
        """Return what was kept, if it is enough and the last refit was long ago."""
        if len(self._kept) < ENOUGH:
            return None
        if self._rest_from_ns is None or now_ns - self._rest_from_ns < REST_NS:
            self._rest_from_ns = self._rest_from_ns or now_ns
            return None
        self._rest_from_ns = now_ns
        kept, names = list(self._kept), self._chain.segments
        self._kept.clear()
        sensors = np.array([row.sensors for row in kept], dtype=np.float64)
        seen = {
            name: np.stack([row.seen[i] for row in kept]).astype(np.float64)
            for i, name in enumerate(names)
        }
        bodies = {n for n, (_, body) in zip(names, self._clusters, strict=True) if body}
        return Fresh(
            {name: sensors[:, i] for i, name in enumerate(self._sensors)},
            {name: x for name, x in seen.items() if name not in bodies},
            {name: x for name, x in seen.items() if name in bodies},
        )

    # --- work --------------------------------------------------------------------------------

    def _missing(self, layout: MocapLayout) -> list[str]:
        """Return what the stream has no name for."""
        missing = [
            name
            for markers, body in self._clusters
            for name in (markers if body is None else (body,))
            if name not in (layout.markers if body is None else layout.bodies)
        ]
        return list(dict.fromkeys(missing))

    def _found(self, layout: MocapLayout) -> list[list[int]]:
        return [
            [layout.markers.index(name) for name in markers]
            if body is None
            else [layout.bodies.index(body)]
            for markers, body in self._clusters
        ]

    def _seen(self, frame: MocapFrame, columns: list[list[int]]) -> list[Array]:
        return [
            frame.markers[rows] if body is None else frame.body_orientations[rows[0]]
            for rows, (_, body) in zip(columns, self._clusters, strict=True)
        ]

    def _unseen(self, seen: list[Array]) -> list[str]:
        """Return markers and bodies that the cameras do not see; mostly none."""
        unseen = []
        for x, (markers, body) in zip(seen, self._clusters, strict=True):
            if np.isfinite(x).all():
                continue
            if body is not None:
                unseen.append(body)
            else:
                whole = np.isfinite(x.sum(axis=1)).tolist()
                unseen += [name for name, there in zip(markers, whole, strict=True) if not there]
        return list(dict.fromkeys(unseen))  # a marker may be of two clusters

    def _pair(self, t_ns: int, seen: list[Array]) -> None:
        """Keep what the sensors said when the cameras saw this, if both are whole and moved."""
        after = None
        for before in reversed(self._frames):
            if before.t_ns <= t_ns:
                break
            after = before
        else:
            return
        if after is None:  # the instants are the same
            after = before
        said = self._said(t_ns, before, after)
        if said is None:
            self._watch.hindered(t_ns, self._silent(before, after))
            return
        self._watch.well(t_ns)
        if self._kept and t_ns - self._kept_ns < STILL_NS:
            last = self._kept[-1].sensors
            if all(_dot(said[i], last[i]) > STILL_DOT for i in self._firsts):
                return
        self._kept.append(_Kept(said, seen))
        self._kept_ns = t_ns

    def _silent(self, before: AlignedFrame, after: AlignedFrame) -> str:
        for sensor in self._sensors:
            if sensor not in before.orientations or sensor not in after.orientations:
                return f"{sensor} gives no data"
        if before.synced and after.synced:
            return "the sensors pause again and again"
        return "the clocks behind the sensors have not settled"

    def _said(
        self, t_ns: int, before: AlignedFrame, after: AlignedFrame
    ) -> list[Quaternion] | None:
        width = after.t_ns - before.t_ns
        if width > GAP_NS or not (before.synced and after.synced):
            return None
        share = (t_ns - before.t_ns) / width if width else 0.0
        said = []
        for sensor, (world, mount) in zip(self._sensors, self._mounts, strict=True):
            first, second = before.orientations.get(sensor), after.orientations.get(sensor)
            if first is None or second is None:
                return None
            q = interpolate_one(first, second, share)
            said.append(multiply_one(multiply_one(world, q), mount))
        return said


def _dot(p: Quaternion, q: Quaternion) -> float:
    return abs(p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3])


def _off(chain: Chain, calibration: Calibration | None, *, wanted: bool) -> str | None:
    """Return why nothing can be learned, whatever the cameras see."""
    if not wanted:
        return "learn_online is off"
    if calibration is None or not calibration.fits(chain):
        return "not calibrated"
    if not calibration.memory:
        return "the calibration has no memory of a movement: run the functional phase once"
    bare = [name for name in chain.segments if name not in calibration.clusters]
    return f"no markers are known of {', '.join(bare)}" if bare else None
