"""Search for markers that do not move with their body part during a movement.

A label, or a list of markers in rig.toml, may already be wrong in the static pose. One marker of a
body part is then on another body part, although all markers agree with the static pose. The
movement shows this fault. Two measures are compared with the range of soft-tissue artefact:

- the change of the distance of two markers of the part, and
- the movement of a marker in the frame of the other markers. A marker near the joint of two parts
  hardly changes its distances, so this measure has a smaller limit. It also contains the rotation
  error of a small cluster. It therefore counts only if the marker moves much less in the frame of
  another part.

Movements are relative to their median, so that a marker that was displaced once is not reported.
Each measure is the upper quartile over the frames, so that labels that are wrong in less than a
quarter of the frames have no effect.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.calibration.anatomy._marker_clusters import marker_columns
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import MIN_MARKERS, is_line, rigid_fit, visible
from jointfit_daemon.name_lists import join_words

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration._trial import OpticalTrack
    from jointfit_daemon.limb_model import MarkerCluster

MOST_MOVEMENT_M = 0.03
"""Upper quartile of the movement of a marker in the frame of the other markers above which the
marker may be on another part, m. Soft-tissue artefact of skin markers is largest at the thigh,
where it exceeds 20 mm (Leardini et al. 2005, Gait & Posture 21, 212-225). Such a marker is reported
only if it moves with another part."""
MOST_DISTANCE_CHANGE_M = 0.04
"""Upper quartile of the change of a distance above which two markers are on different parts, m. It
is the change for two markers with independent artefacts of 30 mm."""
_ELSEWHERE = 0.5
"""Ratio of the movement of a marker in the frame of another part to its movement in the frame of
its own part. Below this ratio, the marker counts as a marker of the other part."""
_SIMILAR = 2.0
"""Largest ratio of the movement in the frame of a part to the smallest movement in the frame of any
part. Up to this ratio, the marker may be on the part, and the report names the part too."""
_SAMPLED = 1500
"""Largest number of frames that are examined."""
_FEWEST = 100
"""Smallest number of examined frames with visible markers from which a movement is computed."""


class ForeignMarker(NamedTuple):
    """Marker that does not move with its body part."""

    marker: str
    part: str
    """Body part to which the marker belongs in rig.toml."""
    others: tuple[str, ...]
    """Markers of the part relative to which the marker moves."""
    rms: float
    """RMS movement relative to these markers, m. If they do not determine a frame, it is the RMS
    change of the distance that changes most.
    """
    elsewhere: tuple[str, ...]
    """Body parts with one of which the marker moves; empty if no part was found."""

    @property
    def text(self) -> str:
        """Return a sentence with the remedy, without a full stop."""
        moves = f", and moves with {' or '.join(self.elsewhere)}" if self.elsewhere else ""
        return (
            f"{self.part}: {self.marker} moves by {1000 * self.rms:.0f} mm RMS relative to "
            f"{join_words(self.others)}{moves}; check that it is fixed, correct the labels in the "
            f"camera software or markers.{self.part} in rig.toml, and repeat from the static pose"
        )


class _PartMarkers(NamedTuple):
    """Markers of one body part that are not known to be foreign."""

    name: str
    markers: tuple[str, ...]
    template: Array
    """Positions in the static pose, m, shape (k, 3)."""
    points: Array
    """Positions in the movement, m, shape (m, k, 3)."""

    def point(self, marker: str) -> Array:
        """Return the positions of a marker, m, shape (m, 3)."""
        return np.asarray(self.points[:, self.markers.index(marker)])

    def without(self, marker: str) -> _PartMarkers:
        """Return the part without a marker."""
        rows = [i for i, name in enumerate(self.markers) if name != marker]
        names = tuple(self.markers[i] for i in rows)
        return _PartMarkers(self.name, names, self.template[rows], self.points[:, rows])


def foreign_markers(
    track: OpticalTrack, clusters: Mapping[str, MarkerCluster]
) -> list[ForeignMarker]:
    """Return the markers that do not move with their body part in a trial.

    Raises
    ------
    CalibrationError
        The stream of the trial does not have a marker.
    """
    rows = np.unique(np.linspace(0, len(track.t_ns) - 1, _SAMPLED).astype(int))
    parts = {
        name: _PartMarkers(
            name,
            cluster.markers,
            cluster.template,
            track.positions[rows][:, marker_columns(track, name, cluster.markers)],
        )
        for name, cluster in clusters.items()
        if cluster.body is None
    }
    found: list[ForeignMarker] = []

    # Distances are compared first, because a marker that they reveal distorts the frame of its
    # part.
    for search in (_by_distances, _by_another_part):
        for name in tuple(parts):
            while (one := search(parts, name)) is not None:
                found.append(one)
                parts[name] = parts[name].without(one.marker)
    return found


def _by_distances(parts: Mapping[str, _PartMarkers], name: str) -> ForeignMarker | None:
    """Return the marker whose distances to the other markers of the part change most."""
    part = parts[name]
    changes = [
        [_upper_quartile(change) for change in _distance_changes(part, marker).T]
        for marker in part.markers
    ]
    if np.max(changes, initial=0.0) <= MOST_DISTANCE_CHANGE_M:
        return None
    return _report(parts, name, part.markers[int(np.sum(changes, axis=1).argmax())])


def _by_another_part(parts: Mapping[str, _PartMarkers], name: str) -> ForeignMarker | None:
    """Return a marker that moves much less in the frame of another part than in its own."""
    part = parts[name]
    for marker in part.markers:
        movement = _movement(part.without(marker), part.point(marker))
        if movement is not None and _upper_quartile(movement) > MOST_MOVEMENT_M:
            found = _report(parts, name, marker)
            if found.elsewhere:
                return found
    return None


def _report(parts: Mapping[str, _PartMarkers], name: str, marker: str) -> ForeignMarker:
    """Return the movement of a marker, and the part with which it moves."""
    point, own = parts[name].point(marker), parts[name].without(marker)
    movement = _movement(own, point)
    if movement is None:
        changes = _distance_changes(parts[name], marker)
        movement = changes[:, int(np.argmax([_upper_quartile(change) for change in changes.T]))]

    most = _ELSEWHERE * _upper_quartile(movement)
    near: dict[str, float] = {}
    for other, part in parts.items():
        there = None if other == name else _movement(part.without(marker), point)
        if there is not None and _upper_quartile(there) < most:
            near[other] = _upper_quartile(there)

    # A foot moves little relative to its shank, so the movements in both frames may be similar.
    elsewhere = tuple(o for o in near if near[o] <= _SIMILAR * min(near.values()))
    rms = float(np.sqrt(np.nanmean(movement**2)))
    return ForeignMarker(marker, name, own.markers, rms, elsewhere)


def _movement(part: _PartMarkers, point: Array) -> Array | None:
    """Return the distances of a point from its median position in the frame of a part, shape (m,).

    The result is None if the markers of the part do not determine a frame.
    """
    if len(part.markers) < MIN_MARKERS or is_line(part.template):
        return None
    q, t, _ = rigid_fit(part.template, part.points)
    local = rotation.rotate(rotation.conjugate(q), point - t)
    local = local[visible(local)]
    if len(local) < _FEWEST:
        return None
    return np.asarray(np.linalg.norm(local - np.median(local, axis=0), axis=1))


def _distance_changes(part: _PartMarkers, marker: str) -> Array:
    """Return the changes of the distances of a marker to all markers of its part, m, shape (m, k).

    A distance that is visible in too few frames counts as unchanged; NaN marks other hidden frames.
    """
    distances = np.linalg.norm(part.points - part.point(marker)[:, None], axis=2)
    changes = np.zeros_like(distances)
    for k, column in enumerate(distances.T):
        seen = np.isfinite(column)
        if np.count_nonzero(seen) >= _FEWEST:
            changes[seen, k] = np.abs(column[seen] - np.median(column[seen]))
            changes[~seen, k] = np.nan
    return np.asarray(changes)


def _upper_quartile(movement: Array) -> float:
    return float(np.nanquantile(movement, 0.75))
