"""Inverse kinematics of a chain model from single mocap frames, at a limited rate.

Invariant: the result does not depend on IMUs. A calibration of the limb affects it only through
refined marker positions.
"""

from __future__ import annotations

from collections import deque
from math import sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.kinematics.accepted_errors import is_accepted
from jointfit_daemon.kinematics.coordinate_tracking import CoordinateTracker
from jointfit_daemon.kinematics.inverse_kinematics import LiveInverseKinematics, LiveOptions
from jointfit_daemon.model import ChainModelState, MarkerFitErrors, MarkerFlag, ModelCoordinate
from jointfit_daemon.pipeline.chain_tracking._marker_monitor import MarkerMonitor
from jointfit_daemon.pipeline.events import Notice, NoticeKind, NoticeLevel
from jointfit_daemon.timing.alignment import RateDivider

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.files.models import LoadedModel
    from jointfit_daemon.kinematics.inverse_kinematics import LivePose
    from jointfit_daemon.model import MocapFrame, MocapLayout
    from jointfit_daemon.pipeline.chain_tracking._marker_monitor import MarkerReport
    from jointfit_daemon.pipeline.events import Output

RECENT_NS = 10_000_000_000
"""Time over which recent errors are computed, ns, equal to a few gait cycles."""
FARTHEST_M = 1000.0
"""Distance from the origin beyond which a marker counts as missing, m. No camera has this range,
and the squares of larger distances would make the solution inaccurate."""
FEWEST_MARKERS = 3
"""Smallest number of markers in a frame for a solution. Fewer markers do not determine the position
of the first segment."""
_FEW_EVALUATIONS = 8
"""Largest number of evaluations of the marker errors in a frame, after which there is still time to
search for exchanged labels in the same frame."""
OPTIONS = LiveOptions(steps=6, huber_m=0.02, restart_interval=5)
"""Options of the solver. The solver takes up to six steps per frame, because fitted frames are
100 ms apart by default. The Huber threshold limits the influence of an exchanged marker until it is
excluded. A restart computes the pose from the markers alone, without the previous pose, and takes
longer than the fit of a frame. The solver therefore restarts less often after unsuccessful
restarts."""


_Coordinates = tuple[tuple[ModelCoordinate, ...], tuple[tuple[float, ...], ...] | None]
"""Coordinates, and the rows of their covariance matrix if it is requested."""


class _FrameErrors(NamedTuple):
    t_ns: int
    square: float
    """Sum of the squared marker errors, m²."""
    markers: int
    maximum: float


class ChainTracker:
    """Fits a chain model to the markers of mocap frames.

    Parameters
    ----------
    loaded : LoadedModel
        The chain model and the names of its coordinates.
    rate_hz : float
        Largest number of fitted frames per second; above 0.
    refined : bool
        Whether the marker positions come from a calibration.
    covariance : bool
        Whether the states contain the covariance of the coordinates.
    """

    def __init__(
        self,
        loaded: LoadedModel,
        rate_hz: float,
        *,
        refined: bool = False,
        covariance: bool = False,
    ) -> None:
        self.loaded, self._options = loaded, (rate_hz, refined, covariance)
        self._refined, self._with_covariance = refined, covariance
        self._model = model = loaded.chain
        self._solver = LiveInverseKinematics(model, OPTIONS)
        self._monitor = MarkerMonitor(model)
        self._coordinates = CoordinateTracker(model, loaded.coordinates)
        self._counts = [len(joint.names) for joint in loaded.coordinates]
        self._starts = np.array([columns.start for columns in model.columns])
        self._unknown = tuple(
            ModelCoordinate(name, is_angle, None, None)
            for joint in loaded.coordinates
            for name, is_angle in zip(joint.names, joint.is_angle, strict=True)
        )
        self._rate = RateDivider(rate_hz)
        self._layout: MocapLayout | None = None
        self._columns: list[int | None] = []
        self._recent: deque[_FrameErrors] = deque()

    def serves(
        self, loaded: LoadedModel, rate_hz: float, *, refined: bool, covariance: bool
    ) -> bool:
        """Return whether a new tracker with these arguments would be equivalent to this tracker."""
        names = [joint.names for joint in loaded.coordinates]
        same_names = names == [joint.names for joint in self.loaded.coordinates]
        same_settings = self._options == (rate_hz, refined, covariance)
        return same_settings and same_names and self._model == loaded.chain

    @property
    def exchanged_labels(self) -> list[str]:
        """Sentences that name the markers whose labels are exchanged at present."""
        return self._monitor.exchanged_labels()

    def add_frame(self, t_ns: int, frame: MocapFrame) -> list[Output]:
        """Return the state of the model if a state is due for this live frame, and notices."""
        if not self._rate.is_due(t_ns):
            self._monitor.search_labels(t_ns)
            return []

        # Collect the M markers of the model in a frame, m, shape (M, 3); NaN where missing.
        if frame.layout is not self._layout:
            self._layout = frame.layout
            column = {name: k for k, name in enumerate(frame.layout.markers)}
            self._columns = [column.get(name) for name in self._model.marker_names]
        padded = np.concatenate((frame.markers, np.full((1, 3), np.nan)))
        found = padded[[-1 if column is None else column for column in self._columns]]
        possible = (np.abs(found) < FARTHEST_M).all(axis=1, keepdims=True)
        measured = np.where(possible, found, np.nan)

        seen: NDArray[np.bool_] = np.asarray(np.isfinite(measured).all(axis=1))
        reports = self._monitor.update(t_ns, seen)
        used: NDArray[np.bool_] = seen & ~self._monitor.excluded & (self._model.weights > 0.0)
        names = self._model.marker_names
        if used.sum() < FEWEST_MARKERS:
            state = self._state(t_ns, frame, (self._unknown, None), dict.fromkeys(names), None)
            return [state, *_notices(t_ns, reports)]

        pose = self._solver.feed(np.where(used[:, None], measured, np.nan))
        # A restart takes as long as a step of the label search. Together they would take too long.
        if pose.evaluations <= _FEW_EVALUATIONS:
            self._monitor.search_labels(t_ns)
        distances, faults = self._monitor.compare(t_ns, measured, pose.rotations, pose.origins)
        shown = {
            name: d if seen_one else None
            for name, d, seen_one in zip(names, distances.tolist(), seen.tolist(), strict=True)
        }
        fit = self._errors(t_ns, distances[used])
        state = self._state(t_ns, frame, self._values(pose), shown, fit)
        return [state, *_notices(t_ns, [*reports, *faults])]

    def _values(self, pose: LivePose) -> _Coordinates:
        values, covariance = self._coordinates.read(pose.state, pose.covariance)
        joint_is_known = np.logical_and.reduceat(pose.determined, self._starts)
        known = np.repeat(joint_is_known, self._counts) & np.isfinite(values)
        sd = np.sqrt(covariance.diagonal())
        coordinates = tuple(
            ModelCoordinate(one.name, one.is_angle, value, spread) if is_known else one
            for one, value, spread, is_known in zip(
                self._unknown, values.tolist(), sd.tolist(), known.tolist(), strict=True
            )
        )
        if not self._with_covariance:
            return coordinates, None
        return coordinates, tuple(map(tuple, covariance[np.ix_(known, known)].tolist()))

    def _errors(self, t_ns: int, distances: Array) -> MarkerFitErrors:
        square, maximum = float((distances**2).sum()), float(distances.max())
        self._recent.append(_FrameErrors(t_ns, square, len(distances), maximum))
        return _fit_errors(square, len(distances), maximum)

    def _state(
        self,
        t_ns: int,
        frame: MocapFrame,
        found: _Coordinates,
        errors: dict[str, float | None],
        fit: MarkerFitErrors | None,
    ) -> ChainModelState:
        while self._recent and t_ns - self._recent[0].t_ns > RECENT_NS:
            self._recent.popleft()
        recent = None
        if self._recent:
            _, squares, counts, largest = zip(*self._recent, strict=True)
            recent = _fit_errors(sum(squares), sum(counts), max(largest))

        coordinates, covariance = found
        open_ones = any(coordinate.value is None for coordinate in coordinates)
        flags = [MarkerFlag.UNDETERMINED.value] if open_ones else []
        return ChainModelState(
            frame.number,
            t_ns,
            self._model.name,
            self._refined,
            coordinates,
            errors,
            fit,
            recent,
            (*flags, *self._monitor.flags(t_ns)),
            covariance,
        )


def _fit_errors(square: float, count: int, maximum: float) -> MarkerFitErrors:
    rms = sqrt(square / count)
    return MarkerFitErrors(rms, maximum, is_accepted(rms, maximum))


def _notices(t_ns: int, reports: Iterable[MarkerReport]) -> list[Output]:
    return [
        Notice(
            t_ns,
            NoticeKind.MARKER,
            report.id,
            report.text,
            NoticeLevel.INFO if report.state == "ok" else NoticeLevel.WARNING,
            {"state": report.state, **report.data},
        )
        for report in reports
    ]
