"""Body parts in the static pose and in trials, from markers or rigid bodies.

A cluster is stored in coordinates of the *static world*, which is the optical world during the
static pose. A pose maps static-world points to their current positions,

    x(t) = R(t) (x_static - origin) + p(t),

so that R is the identity and p the origin in the static pose. All body parts therefore share one
coordinate system in the static pose. NaN marks an invisible marker, and the pose of a part in a
frame without a fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration._errors import CalibrationError, unknown_name
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import (
    MAX_FIT_RMS_M,
    MIN_MARKERS,
    LabelFault,
    LabelSearch,
    MarkerCluster,
    body_parts,
    explain_trial,
    is_line,
    rigid_fit,
    steady_fit,
    visible,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration._trial import CalibrationSettings, OpticalTrack
    from jointfit_daemon.model import Chain


MIN_SEEN_STATIC = 20
"""Smallest number of frames of the static pose in which a marker must be visible."""

_BODY_POINTS = 0.1 / np.sqrt(3.0) * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])


@dataclass(frozen=True, slots=True)
class ClusterTrack:
    """Poses of one body part with k markers in m frames."""

    t_ns: NDArray[np.int64]
    """Time stamps, ns, shape (m,)."""
    q: Array
    """Rotation since the static pose, q_now_static, shape (m, 4); NaN without a pose."""
    p: Array
    """Current position of the cluster origin, optical world, m, shape (m, 3)."""
    points: Array
    """Measured marker positions, optical world, m, shape (m, k, 3)."""
    rms: Array
    """RMS residual of the rigid fit, m, shape (m,)."""
    origin: Array
    """Origin of the cluster in the static world, m, shape (3,)."""
    residuals: Array | None = None
    """Residuals of the cameras for the markers, m, shape (m, k); NaN where unknown."""
    markers: tuple[str, ...] | None = None
    """Names of the k markers; None for a rigid body."""

    def to_static(self, x: Array) -> Array:
        """Return current points, shape (m, ..., 3), in static-world coordinates of this part."""
        extra = (1,) * (x.ndim - 2)
        q = rotation.conjugate(self.q).reshape(len(self.q), *extra, 4)
        p = self.p.reshape(len(self.p), *extra, 3)
        return rotation.rotate(q, x - p) + self.origin

    def carry(self, x_static: Array) -> Array:
        """Return the positions of a static-world point fixed to this part, shape (m, 3)."""
        return rotation.rotate(self.q, x_static - self.origin) + self.p


def columns(track: OpticalTrack, name: str, settings: CalibrationSettings) -> list[int]:
    """Return the columns of the markers of a body part.

    Raises
    ------
    CalibrationError
        Markers are missing in the stream, or there are fewer than three. The message contains all
        missing markers, each with the nearest spelling.
    """
    wanted = settings.markers[name]
    found = marker_columns(track, name, wanted)
    if len(set(wanted)) < MIN_MARKERS:
        raise CalibrationError(
            f"markers.{name}: {len(set(wanted))} markers, at least {MIN_MARKERS} are needed"
        )
    return found


def marker_columns(track: OpticalTrack, name: str, wanted: Sequence[str]) -> list[int]:
    """Return the columns of markers of a body part.

    Raises
    ------
    CalibrationError
        Markers are missing in the stream.
    """
    index = {marker: i for i, marker in enumerate(track.markers)}
    missing = [unknown_name("marker", m, track.markers, wanted) for m in wanted if m not in index]
    if missing:
        raise CalibrationError(*(f"markers.{name}: {text}" for text in missing))
    return [index[m] for m in wanted]


def body_column(track: OpticalTrack, name: str, body: str) -> int:
    """Return the column of a rigid body.

    Raises
    ------
    CalibrationError
        The stream does not have the rigid body; the message has the nearest spelling.
    """
    if body not in track.bodies:
        raise CalibrationError(f"{name}: {unknown_name('rigid body', body, track.bodies)}")
    return track.bodies.index(body)


def static_cluster(track: OpticalTrack, name: str, settings: CalibrationSettings) -> MarkerCluster:
    """Return one body part in the static pose, from medians, which are insensitive to outliers.

    Raises
    ------
    CalibrationError
        Names are missing in the stream, there are fewer than three markers, a marker or the rigid
        body is hardly visible, or all markers are on a line.
    """
    if name not in settings.markers:
        return _static_body(track, name, settings.rigid_bodies[name])

    names = settings.markers[name]
    positions = track.positions[:, columns(track, name, settings)]
    count = visible(positions).sum(axis=0)
    if hidden := [
        f"{m} ({n} frames)" for m, n in zip(names, count, strict=True) if n < MIN_SEEN_STATIC
    ]:
        raise CalibrationError(
            f"markers.{name}: visible in too few frames of the static pose (at least "
            f"{MIN_SEEN_STATIC} are needed): {', '.join(hidden)}; "
            "turn so that the cameras see them, or remove them from rig.toml"
        )

    points = np.nanmedian(positions, axis=0)
    if is_line(points):
        raise CalibrationError(
            f"markers.{name}: {', '.join(names)} are on one line, so that "
            "rotations about it are not observable; "
            "move one marker at least 3 cm away from the line"
        )

    origin = points.mean(axis=0)
    return MarkerCluster(
        name, tuple(names), None, points - origin, origin, rotation.IDENTITY.copy()
    )


def _static_body(track: OpticalTrack, name: str, body: str) -> MarkerCluster:
    column = body_column(track, name, body)
    q, p = track.body_orientations[:, column], track.body_positions[:, column]
    seen = visible(q) & visible(p)
    if np.count_nonzero(seen) < MIN_SEEN_STATIC:
        raise CalibrationError(
            f"{name}: rigid body {body!r} visible in {np.count_nonzero(seen)} frames of the static"
            f" pose, at least {MIN_SEEN_STATIC} are needed; turn so that the cameras see it"
        )

    origin = np.median(p[seen], axis=0)
    return MarkerCluster(name, (), body, _BODY_POINTS.copy(), origin, rotation.average(q[seen]))


def track_cluster(track: OpticalTrack, cluster: MarkerCluster) -> ClusterTrack:
    """Return the poses of one body part in a trial; NaN marks frames without a pose.

    Raises
    ------
    CalibrationError
        The stream of the trial does not have a marker or the rigid body.
    """
    if cluster.body is not None:
        column = body_column(track, cluster.name, cluster.body)
        q_now = rotation.normalize(track.body_orientations[:, column])
        q = rotation.multiply(q_now, rotation.conjugate(cluster.q_body))
        p = track.body_positions[:, column].astype(np.float64)
        points = rotation.rotate(q[:, None], cluster.template) + p[:, None]
        return ClusterTrack(track.t_ns, q, p, points, np.zeros(len(q)), cluster.origin)

    chosen = marker_columns(track, cluster.name, cluster.markers)
    points = track.positions[:, chosen]
    residuals = None if track.residuals is None else track.residuals[:, chosen]
    q, p, rms = steady_fit(cluster.template, points)

    # A larger residual indicates swapped or mislabeled markers. The frame then has no pose.
    wrong = rms > MAX_FIT_RMS_M
    q[wrong], p[wrong] = np.nan, np.nan
    points = np.where(wrong[:, None, None], np.nan, points)
    return ClusterTrack(track.t_ns, q, p, points, rms, cluster.origin, residuals, cluster.markers)


def track_clusters(
    track: OpticalTrack, clusters: Mapping[str, MarkerCluster]
) -> dict[str, ClusterTrack]:
    """Return the poses of every body part in a trial."""
    return {name: track_cluster(track, cluster) for name, cluster in clusters.items()}


def exchanged_labels(
    track: OpticalTrack, clusters: Mapping[str, MarkerCluster]
) -> list[LabelFault]:
    """Return exchanges of marker labels that explain most frames of a trial.

    Raises
    ------
    CalibrationError
        The stream of the trial does not have a marker.
    """
    search = LabelSearch(clusters.values())
    order = [
        column
        for cluster in search.clusters
        for column in marker_columns(track, cluster.name, cluster.markers)
    ]
    faults = explain_trial(search, track.positions[:, order])
    return [fault for fault in faults if len(fault.markers) > 1]


def moving_template(positions: Array) -> Array:
    """Return the positions of k markers on a rigid body, m, shape (k, 3), from a movement.

    `positions` are the measured positions in n frames, m, shape (n, k, 3); NaN where missing.
    The first frame with all markers is the initial template. All frames are aligned with the
    template, and their median is the next template. Both steps are done twice (as in generalized
    Procrustes analysis). The centroid of the result is zero.

    Raises
    ------
    CalibrationError
        No frame contains all markers, or the markers are on a line.
    """
    full = np.flatnonzero(np.isfinite(positions).all(axis=(1, 2)))
    if full.size == 0:
        raise CalibrationError(
            "plate: no frame shows all its markers; hold it where the cameras see all of them"
        )
    template: Array = positions[full[0]] - positions[full[0]].mean(axis=0)
    if is_line(template):
        raise CalibrationError("plate: its markers are on one line; move one at least 3 cm away")

    for _ in range(2):
        q, t, _ = rigid_fit(template, positions)
        local = rotation.rotate(rotation.conjugate(q)[:, None], positions - t[:, None])
        template = np.nanmedian(local, axis=0)
        template -= template.mean(axis=0)
    return template


def marked_parts(settings: CalibrationSettings, chain: Chain) -> list[str]:
    """Return the body parts of the chain with markers or a rigid body in rig.toml."""
    known = {*settings.markers, *settings.rigid_bodies}
    return [part for part in body_parts(chain) if part is not None and part in known]
