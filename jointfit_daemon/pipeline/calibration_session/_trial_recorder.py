"""Recorder of one calibration phase: samples and mocap frames on the host clock, up to a limit."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration import CalibrationTrial, OpticalTrack, SensorTrack

if TYPE_CHECKING:
    from jointfit_daemon.model import MocapFrame, Quaternion

MAX_PHASE_S = 600
"""Longest phase, s. One sensor at 400 Hz then has 240 000 samples, which take about 65 MB."""

_MAX_SAMPLES = MAX_PHASE_S * 400


@dataclass(slots=True)
class TrialRecorder:
    """Stores the samples and mocap frames of one calibration phase.

    Invariant: the times of each track in a trial increase strictly.
    """

    _samples: dict[str, list[tuple[int, Quaternion]]] = field(default_factory=dict)
    _frames: list[tuple[int, MocapFrame]] = field(default_factory=list)
    overflowed: int = 0
    """Number of measurements rejected because the recording was full."""

    def add_sample(self, sensor: str, t_ns: int, q_world_sensor: Quaternion) -> None:
        """Record one orientation."""
        track = self._samples.setdefault(sensor, [])
        if len(track) < _MAX_SAMPLES:
            track.append((t_ns, q_world_sensor))
        else:
            self.overflowed += 1

    def add_mocap(self, t_ns: int, frame: MocapFrame) -> None:
        """Record one mocap frame."""
        if len(self._frames) < _MAX_SAMPLES:
            self._frames.append((t_ns, frame))
        else:
            self.overflowed += 1

    def trial(self, start_ns: int | None = None, end_ns: int | None = None) -> CalibrationTrial:
        """Return the recording between two instants, inclusive."""
        low = -(2**62) if start_ns is None else start_ns
        high = 2**62 if end_ns is None else end_ns
        sensors = {}
        for sensor, track in self._samples.items():
            rows = [row for row in track if low <= row[0] <= high]
            t_ns = np.array([row[0] for row in rows], dtype=np.int64)
            q = np.array([row[1] for row in rows], dtype=np.float64).reshape(-1, 4)
            keep = _increasing(t_ns)
            sensors[sensor] = SensorTrack(t_ns[keep], q[keep])

        frames = [row for row in self._frames if low <= row[0] <= high]
        return CalibrationTrial(sensors, _optical_track(frames) if frames else None)


def _increasing(t_ns: np.ndarray) -> np.ndarray:
    """Return the indices of rows with strictly increasing time; a restarted clock may step back."""
    before = np.concatenate(([np.iinfo(np.int64).min], np.maximum.accumulate(t_ns)))[:-1]
    return np.flatnonzero(t_ns > before)


def _optical_track(frames: list[tuple[int, MocapFrame]]) -> OpticalTrack:
    """Merge frames of one or more layouts by name; names that a layout lacks become NaN."""
    layouts = dict.fromkeys(frame.layout for _, frame in frames)
    markers = tuple(dict.fromkeys(name for layout in layouts for name in layout.markers))
    bodies = tuple(dict.fromkeys(name for layout in layouts for name in layout.bodies))

    n = len(frames)
    positions = np.full((n, len(markers), 3), np.nan)
    body_positions = np.full((n, len(bodies), 3), np.nan)
    body_orientations = np.full((n, len(bodies), 4), np.nan)
    residuals = np.full((n, len(markers)), np.nan)
    # Copy once per layout: a copy per frame would stop the processing of samples for too long.
    for layout in layouts:
        rows = np.array([row for row, (_, frame) in enumerate(frames) if frame.layout == layout])
        seen = [frame for _, frame in frames if frame.layout == layout]
        to_marker = np.array([markers.index(name) for name in layout.markers], dtype=np.intp)
        to_body = np.array([bodies.index(name) for name in layout.bodies], dtype=np.intp)
        positions[np.ix_(rows, to_marker)] = np.stack([frame.markers for frame in seen])
        body_positions[np.ix_(rows, to_body)] = np.stack([frame.body_positions for frame in seen])
        body_orientations[np.ix_(rows, to_body)] = np.stack(
            [frame.body_orientations for frame in seen]
        )
        unknown = np.full(len(layout.markers), np.nan)
        residuals[np.ix_(rows, to_marker)] = np.stack(
            [unknown if frame.residuals is None else frame.residuals for frame in seen]
        )

    t_ns = np.array([t for t, _ in frames], dtype=np.int64)
    keep = _increasing(t_ns)
    return OpticalTrack(
        t_ns[keep],
        markers,
        positions[keep],
        bodies,
        body_positions[keep],
        body_orientations[keep],
        residuals[keep] if np.isfinite(residuals[keep]).any() else None,
    )
