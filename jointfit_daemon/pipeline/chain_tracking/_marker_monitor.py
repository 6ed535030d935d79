"""Detection of lost, exchanged and misplaced markers from their distances to a chain model.

Faulty markers are excluded from inverse kinematics. They are still compared with the model, so that
their recovery is detected.

Invariant: markers are excluded only while the other markers fit the model. This requires that at
most a third of the visible markers is far from the model positions, and that the median distance is
small. Otherwise the model itself does not fit. The monitor then reports the misfit and excludes no
marker.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.kinematics.exchanged_labels import find_exchanged_labels
from jointfit_daemon.limb_model import LabelFault
from jointfit_daemon.model import MarkerFlag
from jointfit_daemon.name_lists import join_words
from jointfit_daemon.pipeline.chain_tracking._segment_labels import SegmentLabels

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chains import ChainModel

FAR_M = 0.06
"""Distance from the model position above which a marker is misplaced, m. Soft-tissue artefact is
smaller, and so is the largest accepted marker error, 0.04 m."""
NEAR_M = 0.03
"""Distance from the model position below which a faulty marker can recover, m. In a model that
fits, the median distance of the visible markers is also smaller."""
FAULT_NS = 1_000_000_000
"""Time for which a marker must be misplaced, exchanged or hidden before it is flagged, ns."""
RECOVERY_NS = 2_000_000_000
"""Time for which a faulty marker must be near its model position before it is used again, ns."""
LOST_REPORT_NS = 10_000_000_000
"""Time for which a marker must be hidden before a notice, ns. Occlusions of seconds are
frequent."""
_MOST_EXCLUDED = 1 / 3
_MEMORY = 0.02
"""Weight of a new frame in the mean position of a misplaced marker. At 10 Hz, the time constant of
the mean is 5 s."""
_OBSERVED = 50
"""Number of frames after which the movement of a misplaced marker is compared with the segments."""
_RIGID_M = 0.012
"""Standard deviation of a marker's position in the axes of a segment, m, below which the marker is
attached to this segment."""
_MOVING_M = 0.025
"""Standard deviation of a marker's position in the axes of its own segment, m, above which the
marker is not attached to this segment."""


class MarkerReport(NamedTuple):
    """A change of a marker or model that requires a notice."""

    id: str
    """Name of the marker or of the model."""
    state: str
    """New state: a `MarkerFlag`, or ``ok``."""
    text: str
    data: Mapping[str, object]


@dataclass(slots=True)
class _Observation:
    """Mean (m) and variance (m²) of a misplaced marker's position in the axes of every segment."""

    mean: Array
    variance: Array
    frames: int = 1
    reported: bool = False


@dataclass(slots=True)
class MarkerMonitor:
    """Monitors the markers of one chain model.

    Parameters
    ----------
    model
        The chain model.
    """

    model: ChainModel
    excluded: NDArray[np.bool_] = field(init=False)
    """Mask of the markers that inverse kinematics must not use, shape (M,) for M markers."""
    misfit: bool = False
    """Whether the model as a whole does not fit."""
    _seen_ns: list[int | None] = field(init=False)
    """Instant at which each marker was visible for the last time."""
    _reported_lost: set[str] = field(default_factory=set)
    _since_ns: dict[str, dict[str, int]] = field(default_factory=dict)
    """Start of each condition, by kind of condition and flag."""
    _faults: dict[str, tuple[int, ...]] = field(default_factory=dict)
    """Markers concerned by each current flag."""
    _observed: dict[int, _Observation] = field(default_factory=dict)
    _began_ns: int | None = None
    _labels: SegmentLabels = field(init=False)
    _by_shape: set[str] = field(default_factory=set)
    """Current flags of exchanged markers that were found from the shapes of the segments."""

    def __post_init__(self) -> None:
        self._labels = SegmentLabels(self.model)
        count = len(self.model.markers)
        self.excluded = np.zeros(count, dtype=np.bool_)
        self._seen_ns = [None] * count

    def flags(self, t_ns: int) -> tuple[str, ...]:
        """Return the current flags."""
        lost = [
            f"{MarkerFlag.LOST}:{marker.name}"
            for marker, seen_ns in zip(self.model.markers, self._seen_ns, strict=True)
            if marker.weight > 0.0 and t_ns - self._hidden_since(seen_ns, t_ns) > FAULT_NS
        ]
        misfit = [MarkerFlag.MISFIT.value] if self.misfit else []
        return (*misfit, *self._faults, *lost)

    def exchanged_labels(self) -> list[str]:
        """Return a sentence for each current exchange of labels, without a full stop."""
        return [self._exchange(m).text for m in self._faults.values() if len(m) > 1]

    def _exchange(self, markers: tuple[int, ...]) -> LabelFault:
        """Return the exchange of two or more labels."""
        found = [self.model.markers[m] for m in markers]
        parts = tuple(sorted({marker.segment for marker in found}))
        return LabelFault(tuple(marker.name for marker in found), parts)

    def _hidden_since(self, seen_ns: int | None, t_ns: int) -> int:
        if seen_ns is not None:
            return seen_ns
        return t_ns if self._began_ns is None else self._began_ns

    def search_labels(self, t_ns: int) -> None:
        """Continue the search for exchanged labels during a camera frame."""
        self._labels.advance(t_ns)

    def update(self, t_ns: int, seen: NDArray[np.bool_]) -> list[MarkerReport]:
        """Store which markers are visible in a frame; `seen` has the shape (M,).

        Return reports of markers that were hidden for `LOST_REPORT_NS`, or that are visible again.
        """
        self._began_ns = t_ns if self._began_ns is None else self._began_ns
        reports = []
        for m, marker in enumerate(self.model.markers):
            name, hidden_ns = marker.name, t_ns - self._hidden_since(self._seen_ns[m], t_ns)
            if seen[m]:
                self._seen_ns[m] = t_ns
                if name in self._reported_lost:
                    self._reported_lost.remove(name)
                    text = f"{name}: visible again after {hidden_ns / 1e9:.0f} s"
                    reports.append(MarkerReport(name, "ok", text, {"hidden_s": hidden_ns / 1e9}))
            elif hidden_ns > LOST_REPORT_NS and name not in self._reported_lost and seen.any():
                self._reported_lost.add(name)
                text = (
                    f"{name}: not visible for {hidden_ns / 1e9:.0f} s; the other markers are used. "
                    "Uncover it, fix it, or correct its name"
                )
                reports.append(
                    MarkerReport(name, MarkerFlag.LOST, text, {"hidden_s": hidden_ns / 1e9})
                )
        return reports

    def compare(
        self, t_ns: int, measured: Array, rotations: Array, origins: Array
    ) -> tuple[Array, list[MarkerReport]]:
        """Compare the markers of one frame with a pose of the model.

        Parameters
        ----------
        t_ns
            Instant of the frame.
        measured
            Marker positions in the world, m, shape (M, 3); NaN where hidden.
        rotations, origins
            Poses of the S segments in the world, shapes (S, 3, 3) and (S, 3), m.

        Returns
        -------
        distances
            Distances of the markers from their model positions, m, shape (M,); NaN where hidden.
        reports
            Faults that began or ended.
        """
        segments = self.model.marker_segments
        places = (rotations[segments] @ self.model.positions[:, :, None])[..., 0]
        places += origins[segments]
        distances = np.sqrt(((places - measured) ** 2).sum(axis=1))

        far = distances > FAR_M  # the comparison is False where NaN
        exchanged: list[tuple[int, ...]] = []
        if far.any() or self._by_shape:
            # Exchanged markers rotate a fitted segment, so the shapes of the segments are checked
            # first. The positions of the markers are checked second.
            self._labels.begin(t_ns, measured)
            exchanged = [*self._labels.faults]
            turned = {segments[m] for group in exchanged for m in group}
            far &= ~np.isin(segments, list(turned))
            exchanged += find_exchanged_labels(places, measured, far)
        else:
            self._labels.forget()
        grouped = {m for group in exchanged for m in group}
        suspects = {self._flag(MarkerFlag.EXCHANGED, *group): group for group in exchanged}
        for m in np.flatnonzero(far).tolist():
            if m not in grouped and not self.excluded[m]:
                suspects[self._flag(MarkerFlag.MISPLACED, m)] = (m,)

        reports = self._recover(t_ns, distances)
        reports += self._exclude(t_ns, suspects, distances)
        return distances, [*reports, *self._observe(measured, rotations, origins, distances)]

    def _flag(self, kind: MarkerFlag, *markers: int) -> str:
        return f"{kind}:{'~'.join(self.model.markers[m].name for m in markers)}"

    def _lasting(self, t_ns: int, condition: str, flags: Iterable[str], least_ns: int) -> set[str]:
        """Return the `flags` whose condition has lasted for `least_ns`.

        The start of the condition is forgotten for every flag that is not in `flags`.
        """
        before = self._since_ns.get(condition, {})
        now = self._since_ns[condition] = {flag: before.get(flag, t_ns) for flag in flags}
        return {flag for flag, since_ns in now.items() if t_ns - since_ns >= least_ns}

    def _exclude(
        self, t_ns: int, suspects: Mapping[str, tuple[int, ...]], distances: Array
    ) -> list[MarkerReport]:
        """Exclude markers that were suspect for `FAULT_NS`, unless the whole model does not fit."""
        lasting = self._lasting(t_ns, "far", suspects, FAULT_NS)
        if not lasting and not self.misfit:
            return []
        visible = np.isfinite(distances)
        few = int(((distances > FAR_M) & visible).sum()) <= _MOST_EXCLUDED * int(visible.sum())
        fits = few and float(np.median(distances[visible])) < NEAR_M
        if self.misfit:
            ended = self._lasting(t_ns, "fits", [MarkerFlag.MISFIT] if fits else [], RECOVERY_NS)
            self.misfit = not ended
            text = f"chain model {self.model.name!r} fits"
            return [MarkerReport(self.model.name, "ok", text, {})] if ended else []

        new = {
            flag: suspects[flag]
            for flag in sorted(lasting)
            if not self.excluded[list(suspects[flag])].any()
        }
        if new and not fits:
            self.misfit = True
            rms = float(np.sqrt(np.nanmean(distances**2)))
            text = (
                f"chain model {self.model.name!r} does not fit: markers are {1000 * rms:.0f} mm "
                "RMS from their places: check the subject, the scale of the model, and the labels"
            )
            return [MarkerReport(self.model.name, MarkerFlag.MISFIT, text, {"rms_m": rms})]

        reports = []
        for flag, markers in new.items():
            self._faults[flag] = markers
            if len(markers) > 1 and not self._labels.fit(markers):
                self._by_shape.add(flag)
            self.excluded[list(markers)] = True
            reports.append(self._report(markers, distances))
        return reports

    def _report(self, markers: tuple[int, ...], distances: Array) -> MarkerReport:
        names = [self.model.markers[m].name for m in markers]
        shown = join_words(f"{1000 * distances[m]:.0f} mm" for m in markers)
        if len(markers) > 1:
            text = (
                f"{join_words(names)} look exchanged ({shown} from their places in the model): "
                f"{self._exchange(markers).places}. Correct their labels; inverse kinematics "
                "excludes them until then"
            )
            return MarkerReport(names[0], MarkerFlag.EXCHANGED, text, {"markers": names})
        segment = self.model.markers[markers[0]].segment
        text = (
            f"{names[0]}: {shown} from its place on {segment} in the model: check its label, its "
            "place and its segment. Inverse kinematics excludes it until then"
        )
        return MarkerReport(names[0], MarkerFlag.MISPLACED, text, {"segment": segment})

    def _recover(self, t_ns: int, distances: Array) -> list[MarkerReport]:
        """Use faulty markers again if they are near their model positions."""
        # Without the excluded markers, a segment may have no pose. In this case the shape of the
        # segment is checked instead.
        near = [
            flag
            for flag, m in self._faults.items()
            if (
                self._labels.fit(m)
                if flag in self._by_shape
                else (distances[list(m)] < NEAR_M).all()
            )
        ]
        reports = []
        for flag in sorted(self._lasting(t_ns, "near", near, RECOVERY_NS)):
            markers = self._faults.pop(flag)
            self._by_shape.discard(flag)
            self.excluded[list(markers)] = False
            names = [self.model.markers[m].name for m in markers]
            text = f"{join_words(names)}: at the expected place again, and in use"
            reports.append(MarkerReport(names[0], "ok", text, {"markers": names}))
        return reports

    def _observe(
        self, measured: Array, rotations: Array, origins: Array, distances: Array
    ) -> list[MarkerReport]:
        """Compare the movement of misplaced markers with the movement of every segment."""
        single = {markers[0] for markers in self._faults.values() if len(markers) == 1}
        self._observed = {m: seen for m, seen in self._observed.items() if m in single}
        reports = []
        for m in single:
            if not np.isfinite(distances[m]):
                continue
            # Position of the marker in the axes of each segment, m, shape (S, 3).
            x = np.einsum("sji,sj->si", rotations, measured[m] - origins)
            seen = self._observed.setdefault(m, _Observation(x, np.zeros(len(x))))
            off = x - seen.mean
            seen.mean = seen.mean + _MEMORY * off
            seen.variance = (1 - _MEMORY) * (seen.variance + _MEMORY * (off**2).sum(axis=1))
            seen.frames += 1

            own, sd = int(self.model.marker_segments[m]), np.sqrt(seen.variance)
            best = int(sd.argmin())
            fixed_elsewhere = best != own and sd[best] < _RIGID_M and sd[own] > _MOVING_M
            if seen.frames > _OBSERVED and fixed_elsewhere and not seen.reported:
                seen.reported = True
                marker, segment = self.model.markers[m], self.model.segment_names[best]
                text = (
                    f"{marker.name}: moves with {segment}, but the model has it on "
                    f"{marker.segment}: move the marker, or correct its segment"
                )
                data = {"segment": marker.segment, "moves_with": segment}
                reports.append(MarkerReport(marker.name, MarkerFlag.MISPLACED, text, data))
        return reports
