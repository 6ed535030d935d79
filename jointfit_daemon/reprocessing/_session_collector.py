"""Collection of the measurements and outputs of a core as arrays of a session.

All series use the clock of the cameras. For this purpose, the lag of each sensor is subtracted from
its timestamps. The lags are those in use at the end of the session, from the calibration or from
rig.toml. Rows that are not later than the previous row are omitted, because a clock that settles or
restarts may step back.
"""

from __future__ import annotations

from array import array
from dataclasses import replace
from math import nan
from operator import itemgetter
from sys import intern
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.model import (
    ANGLE_NAMES,
    FrameFlag,
    FusionMode,
    LimbState,
    MocapFrame,
    OpticalState,
)
from jointfit_daemon.pipeline.events import CalibrationStatus, ChunkArrived, Notice, UnixOffset
from jointfit_daemon.session_data import (
    FrameSeries,
    JointSeries,
    MarkerSeries,
    SegmentSeries,
    SensorSeries,
    SessionData,
    TimelineEvent,
)
from jointfit_daemon.units import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.config import Rig
    from jointfit_daemon.model import AngleConvention, JointState, OpticalJoint
    from jointfit_daemon.outputs.recording import RecordingGap
    from jointfit_daemon.pipeline import StampedMeasurement
    from jointfit_daemon.pipeline.events import Event, Output
    from jointfit_daemon.pipeline.health import CoreHealth

_UNKNOWN_Q = (nan,) * 4
_UNKNOWN_VECTOR = (nan,) * 3


class _Rows:
    """Rows of numbers with increasing instants.

    Each number takes only eight bytes, because sessions may last for hours.
    """

    __slots__ = ("_t_ns", "_values", "_width")

    def __init__(self, width: int) -> None:
        self._width, self._t_ns, self._values = width, array("q"), array("d")

    def add(self, t_ns: int, *parts: Sequence[float]) -> None:
        """Append `parts` as one row if `t_ns` is later than the instant of the last row."""
        if not self._t_ns or t_ns > self._t_ns[-1]:
            self._t_ns.append(t_ns)
            for part in parts:
                self._values.extend(part)

    def t_s(self, begin_ns: int) -> Array:
        """Return the instants since `begin_ns`, s, shape (n,)."""
        times: Array = (np.array(self._t_ns, dtype=np.int64) - begin_ns) / NS_PER_S
        return times

    def columns(self, first: int, count: int) -> Array:
        """Return `count` columns, from column `first` on, shape (n, count)."""
        table: Array = np.array(self._values).reshape(-1, self._width)[:, first : first + count]
        return table

    def known_columns(self, first: int, count: int) -> Array | None:
        """Return `count` columns, from column `first` on; None if all values are unknown."""
        table = self.columns(first, count)
        return None if np.isnan(table).all() else table


class SessionCollector:
    """Collects one session from the events, measurements and outputs of a core."""

    def __init__(self) -> None:
        self._begin_ns: int | None = None
        self._offset_ns: int | None = None
        self._sensors: dict[str, _Rows] = {}
        self._frames: list[tuple[int, MocapFrame]] = []
        self._segments: dict[str, _Rows] = {}
        self._joints: dict[str, tuple[AngleConvention, _Rows]] = {}
        self._optical_segments: dict[str, _Rows] = {}
        self._optical_joints: dict[str, tuple[AngleConvention, _Rows]] = {}
        self._states_ns = array("q")
        self._modes: list[str] = []
        self._flags: list[str] = []
        self._latencies_ns = array("q")
        self._measured_origins: list[bool] = []
        """For each limb state, whether cameras measured the position of the limb."""
        self._events: list[tuple[int, TimelineEvent]] = []

    def add_measurement(self, source: str, item: StampedMeasurement) -> None:
        """Add one stamped sample or camera frame."""
        measurement, stamp = item
        if isinstance(measurement, MocapFrame):
            if measurement.live and (not self._frames or stamp.t_ns > self._frames[-1][0]):
                self._frames.append((stamp.t_ns, measurement))
            return
        self._sensors.setdefault(source, _Rows(13)).add(
            stamp.t_ns,
            measurement.q_world_sensor,
            measurement.rate or _UNKNOWN_VECTOR,
            measurement.acceleration or _UNKNOWN_VECTOR,
            measurement.magnetic or _UNKNOWN_VECTOR,
        )

    def add_event(self, event: Event, outputs: Iterable[Output]) -> None:
        """Add one event and its outputs."""
        if self._begin_ns is None and not isinstance(event, ChunkArrived):
            self._begin_ns = event.t_ns
        if isinstance(event, UnixOffset) and self._offset_ns is None:
            self._offset_ns = event.offset_ns
        for output in outputs:
            match output:
                case LimbState():
                    self._add_state(output)
                case OpticalState():
                    self._add_optical(output)
                case Notice(t_ns, kind, name, text, level, data):
                    data = {**data, "level": level.value}
                    self._events.append((t_ns, TimelineEvent(0.0, kind, name, text, data)))
                case CalibrationStatus(t_ns, phase, text, version, quality, kept):
                    details = {"version": version, "quality": quality, "kept": kept}
                    one = TimelineEvent(0.0, "calibration", phase, text, details)
                    self._events.append((t_ns, one))
                case _:
                    pass

    def _add_state(self, state: LimbState) -> None:
        self._latencies_ns.append(state.completed_ns - state.t_ns)
        if not self._states_ns or state.t_ns > self._states_ns[-1]:
            self._states_ns.append(state.t_ns)
            self._modes.append(state.mode.value)
            self._flags.append(intern(" ".join(state.flags)))  # equal texts share memory
        for segment in state.segments:
            self._segments.setdefault(segment.name, _Rows(5)).add(
                state.t_ns, segment.q_world_segment or _UNKNOWN_Q, (_number(segment.sd),)
            )
        measured = (
            state.mode is FusionMode.IMU_AND_MOCAP and FrameFlag.ORIGIN_FIXED not in state.flags
        )
        self._measured_origins.append(measured)
        for joint in state.joints:
            _, rows = self._joints.setdefault(joint.name, (joint.convention, _Rows(9)))
            sds = (_number(joint.angle_sd), _number(joint.position_sd))
            rows.add(state.t_ns, *_angles_and_position(joint), sds, (float(measured),))

    def _add_optical(self, state: OpticalState) -> None:
        for segment in state.segments:
            self._optical_segments.setdefault(segment.name, _Rows(4)).add(
                state.t_ns, segment.q_world_segment or _UNKNOWN_Q
            )
        for joint in state.joints:
            _, rows = self._optical_joints.setdefault(joint.name, (joint.convention, _Rows(6)))
            rows.add(state.t_ns, *_angles_and_position(joint))

    def add_gap(self, gap: RecordingGap) -> None:
        """Add a gap of the recording to the time line."""
        data = {"seconds": gap.seconds, "messages": gap.count}
        event = TimelineEvent(0.0, "gap", text=gap.text(), data=data)
        self._events.append((gap.from_t_ns, event))

    def add_health(self, t_ns: int, rig: Rig, health: CoreHealth) -> None:
        """Add clocks, sample counts and latency of the run as events at the end of the session."""
        rates = {source.id: source.rate_hz for source in rig.sources}
        found = []
        for name, device in health.devices.items():
            clock, counts = device.clock, device.wire
            wire = {"lost": counts.lost, "corrupt": counts.corrupt, "restarts": counts.restarts}
            sigma_ns, jitter_ns = clock.sigma_ns, clock.jitter_ns
            time = {
                "state": clock.state,
                "sd_us": None if sigma_ns is None else sigma_ns / 1e3,
                "skew_ppm": clock.skew_ppm,
                "jitter_us": None if jitter_ns is None else jitter_ns / 1e3,
            }
            found += [
                TimelineEvent(0.0, "clock", name, data=time),
                TimelineEvent(
                    0.0, "source", name, data={**device.samples, **wire, "rate_hz": rates[name]}
                ),
            ]
        if self._latencies_ns:
            latencies_ms = np.array(self._latencies_ns) / 1e6
            median, p95 = np.percentile(latencies_ms, (50, 95)).tolist()
            data = {"median_ms": median, "p95_ms": p95, "max_ms": float(latencies_ms.max())}
            found.append(TimelineEvent(0.0, "latency", data=data))
        self._events += [(t_ns, event) for event in found]

    def session(
        self, rig: Rig, lags_ns: Mapping[str, int], description: Mapping[str, str]
    ) -> SessionData:
        """Return the session.

        Parameters
        ----------
        rig
            Configuration at the end of the session.
        lags_ns
            Lag of each sensor behind the cameras, ns.
        description
            Description of the origin of the data.
        """
        begin_ns = self._begin_ns or 0
        segments = {
            name: segment
            for segment, group in zip(rig.chain.segments, rig.chain.sensors, strict=True)
            for name in group
        }
        return SessionData(
            rig.name,
            None if self._offset_ns is None else begin_ns + self._offset_ns,
            sensors=tuple(
                SensorSeries(
                    name,
                    segments.get(name, ""),
                    rows.t_s(begin_ns + lags_ns.get(name, 0)),
                    rows.columns(0, 4),
                    *(rows.known_columns(first, 3) for first in (4, 7, 10)),
                )
                for name, rows in sorted(self._sensors.items())
            ),
            markers=_marker_series(self._frames, begin_ns),
            segments=tuple(
                SegmentSeries(
                    name, rows.t_s(begin_ns), rows.columns(0, 4), rows.columns(4, 1).ravel()
                )
                for name, rows in self._segments.items()
            ),
            joints=tuple(
                _joint_series(name, convention, rows, begin_ns)
                for name, (convention, rows) in self._joints.items()
            ),
            optical_segments=tuple(
                SegmentSeries(name, rows.t_s(begin_ns), rows.columns(0, 4))
                for name, rows in self._optical_segments.items()
            ),
            optical_joints=tuple(
                _joint_series(name, convention, rows, begin_ns, sds=False)
                for name, (convention, rows) in self._optical_joints.items()
            ),
            events=tuple(self._timeline(begin_ns)),
            description=description,
            frames=self._frame_series(begin_ns),
        )

    def _frame_series(self, begin_ns: int) -> FrameSeries | None:
        if not self._states_ns:
            return None
        t_s = (np.array(self._states_ns, dtype=np.int64) - begin_ns) / NS_PER_S
        return FrameSeries(t_s, tuple(self._modes), tuple(self._flags))

    def _timeline(self, begin_ns: int) -> Iterator[TimelineEvent]:
        """Yield the events in the order of their instants, which are relative to the start."""
        events = sorted([*self._position_events(begin_ns), *self._events], key=itemgetter(0))
        for t_ns, event in events:
            yield replace(event, t_s=(t_ns - begin_ns) / NS_PER_S)

    def _position_events(self, begin_ns: int) -> list[tuple[int, TimelineEvent]]:
        """Return one event if the cameras measured the limb's position in only some frames."""
        frames, measured = len(self._measured_origins), sum(self._measured_origins)
        if measured in {0, frames}:
            return []
        unknown = frames - measured
        text = (
            f"the cameras did not measure the position of the limb in {unknown} of {frames} "
            "frames, so these positions are unknown"
        )
        data = {"unknown": unknown, "frames": frames}
        return [(begin_ns, TimelineEvent(0.0, "positions", text=text, data=data))]


def _number(value: float | None) -> float:
    return nan if value is None else value


def _angles_and_position(joint: JointState | OpticalJoint) -> tuple[Sequence[float], ...]:
    return joint.angles or _UNKNOWN_VECTOR, joint.position or _UNKNOWN_VECTOR


def _joint_series(
    name: str, convention: AngleConvention, rows: _Rows, begin_ns: int, *, sds: bool = True
) -> JointSeries:
    angles, names = rows.known_columns(0, 3), ANGLE_NAMES[convention]
    known = {} if angles is None else dict(zip(names, angles.T, strict=True))
    angle_sd, position = None, rows.known_columns(3, 3)
    position_sd = None
    if sds:
        angle_sd, position_sd = rows.known_columns(6, 1), rows.known_columns(7, 1)
        # Positions from the fixed origin and from the cameras differ by an unknown vector. If the
        # session contains positions of both kinds, only those from the cameras are kept.
        measured = rows.columns(8, 1).ravel() > 0.0
        if position is not None and measured.any():
            position[~measured] = nan
            if position_sd is not None:
                position_sd[~measured] = nan
    main = "elevation" if "elevation" in names else "flexion"
    return JointSeries(
        name,
        rows.t_s(begin_ns),
        known,
        {} if angle_sd is None or not known else {main: angle_sd.ravel()},
        position,
        None if position_sd is None else position_sd.ravel(),
    )


def _marker_series(frames: Sequence[tuple[int, MocapFrame]], begin_ns: int) -> MarkerSeries | None:
    """Return the markers of all frames; a marker that a frame does not contain is NaN there."""
    layouts = dict.fromkeys(frame.layout for _, frame in frames)
    labels = tuple(dict.fromkeys(label for layout in layouts for label in layout.markers))
    if not labels:
        return None
    columns = {layout: [labels.index(label) for label in layout.markers] for layout in layouts}
    positions = np.full((len(frames), len(labels), 3), nan)
    for row, (_, frame) in enumerate(frames):
        positions[row, columns[frame.layout]] = frame.markers
    stamps = np.array([t_ns for t_ns, _ in frames], dtype=np.int64)
    return MarkerSeries(labels, (stamps - begin_ns) / NS_PER_S, positions)
