"""Body parts from what the cameras see: rigid fits of arbitrary markers to how they stood still.

Law: a cluster keeps the *static world*: its coordinates are those of the optical world while the
wearer stood still. A pose moves static-world points to where they are now,

    x(t) = R(t) (x_static - origin) + p(t),

so R is the identity and p the origin in the static pose, and all body parts share one set of
coordinates there. NaN is "not seen" and stays NaN.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jointfit_daemon.calibration._errors import CalibrationRefused, unknown_name
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import (
    MAX_FIT_RMS_M,
    MIN_MARKERS,
    Cluster,
    body_parts,
    is_line,
    rigid_fit,
    steady_fit,
    visible,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from jointfit_daemon.calibration._trial import CalibrationSettings
    from jointfit_daemon.model import Chain

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration._trial import CalibrationSettings, OpticalTrack


MIN_SEEN_STATIC = 20
"""Frames in which a marker must be seen while still."""

_BODY_POINTS = 0.1 / np.sqrt(3.0) * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])


@dataclass(frozen=True, slots=True)
class ClusterTrack:
    """Where one body part was over time."""

    t_ns: NDArray[np.int64]
    """Shape (m,)."""
    q: Array
    """q_now_static, shape (m, 4); NaN where too little was seen."""
    p: Array
    """Where the cluster's origin was, optical world, m, shape (m, 3)."""
    points: Array
    """Marker positions as seen, optical world, m, shape (m, k, 3)."""
    rms: Array
    """RMS distance of the markers from their rigid fit, m, shape (m,)."""
    origin: Array
    """The cluster's origin in the static world, m, shape (3,)."""

    def to_static(self, x: Array) -> Array:
        """Take points seen now, shape (m, ..., 3), to this body part's static-world coordinates."""
        extra = (1,) * (x.ndim - 2)
        q = rotation.conjugate(self.q).reshape(len(self.q), *extra, 4)
        p = self.p.reshape(len(self.p), *extra, 3)
        return rotation.rotate(q, x - p) + self.origin

    def carry(self, x_static: Array) -> Array:
        """Return where a static-world point fixed to this body part was, shape (m, 3)."""
        return rotation.rotate(self.q, x_static - self.origin) + self.p


def columns(track: OpticalTrack, name: str, settings: CalibrationSettings) -> list[int]:
    """Return the columns of a body part's markers.

    Raises
    ------
    CalibrationRefused
        A marker is not in the stream (every such one, each with the nearest spelling), or there are
        fewer than three.
    """
    wanted = settings.markers[name]
    index = {marker: i for i, marker in enumerate(track.markers)}
    if missing := [unknown_name("marker", m, track.markers) for m in wanted if m not in index]:
        raise CalibrationRefused(*(f"markers.{name}: {text}" for text in missing))
    if len(set(wanted)) < MIN_MARKERS:
        raise CalibrationRefused(
            f"markers.{name}: {len(set(wanted))} markers, at least {MIN_MARKERS} are needed"
        )
    return [index[m] for m in wanted]


def body_column(track: OpticalTrack, name: str, body: str) -> int:
    """Return the column of a rigid body; CalibrationRefused names the nearest spelling."""
    if body not in track.bodies:
        raise CalibrationRefused(f"{name}: {unknown_name('rigid body', body, track.bodies)}")
    return track.bodies.index(body)


def static_cluster(track: OpticalTrack, name: str, settings: CalibrationSettings) -> Cluster:
    """Learn one body part from the static pose: component-wise medians, which outliers do not move.

    Raises
    ------
    CalibrationRefused
        Names unknown to the stream, a marker hardly seen, or all markers on a line.
    """
    if name not in settings.markers:
        return _static_body(track, name, settings.rigid_bodies[name])
    names = settings.markers[name]
    positions = track.positions[:, columns(track, name, settings)]
    count = visible(positions).sum(axis=0)
    if hidden := [
        f"{m} ({n} frames)" for m, n in zip(names, count, strict=True) if n < MIN_SEEN_STATIC
    ]:
        raise CalibrationRefused(
            f"markers.{name}: hardly seen while standing still: {', '.join(hidden)}; "
            "turn so that the cameras see them, or take them out of rig.toml"
        )
    points = np.nanmedian(positions, axis=0)
    if is_line(points):
        raise CalibrationRefused(
            f"markers.{name}: {', '.join(names)} lie on one line: turns about it do not show; "
            "move one marker at least 3 cm aside"
        )
    origin = points.mean(axis=0)
    return Cluster(name, tuple(names), None, points - origin, origin, rotation.IDENTITY.copy())


def _static_body(track: OpticalTrack, name: str, body: str) -> Cluster:
    column = body_column(track, name, body)
    q, p = track.body_orientations[:, column], track.body_positions[:, column]
    seen = visible(q) & visible(p)
    if np.count_nonzero(seen) < MIN_SEEN_STATIC:
        raise CalibrationRefused(
            f"rigid body {body!r} of {name}: seen in {np.count_nonzero(seen)} frames while standing"
            " still; turn so that the cameras see it"
        )
    origin = np.median(p[seen], axis=0)
    return Cluster(name, (), body, _BODY_POINTS.copy(), origin, rotation.average(q[seen]))


def track_cluster(track: OpticalTrack, cluster: Cluster) -> ClusterTrack:
    """Follow one body part through a trial; see `rigid_fit` for what NaN means.

    Raises
    ------
    CalibrationRefused
        The trial's stream lacks a marker or the body.
    """
    if cluster.body is not None:
        column = body_column(track, cluster.name, cluster.body)
        q_now = rotation.normalize(track.body_orientations[:, column])
        q = rotation.multiply(q_now, rotation.conjugate(cluster.q_body))
        p = track.body_positions[:, column].astype(np.float64)
        points = rotation.rotate(q[:, None], cluster.template) + p[:, None]
        return ClusterTrack(track.t_ns, q, p, points, np.zeros(len(q)), cluster.origin)
    if missing := [
        unknown_name("marker", m, track.markers) for m in cluster.markers if m not in track.markers
    ]:
        raise CalibrationRefused(*(f"markers.{cluster.name}: {text}" for text in missing))
    points = track.positions[:, [track.markers.index(m) for m in cluster.markers]]
    q, p, rms = steady_fit(cluster.template, points)
    wrong = rms > MAX_FIT_RMS_M
    q[wrong], p[wrong] = np.nan, np.nan
    points = np.where(wrong[:, None, None], np.nan, points)
    return ClusterTrack(track.t_ns, q, p, points, rms, cluster.origin)


def track_clusters(track: OpticalTrack, clusters: Mapping[str, Cluster]) -> dict[str, ClusterTrack]:
    """Follow every body part through a trial."""
    return {name: track_cluster(track, cluster) for name, cluster in clusters.items()}


def moving_template(positions: Array) -> Array:
    """Return marker positions on a rigid body that moved, m, (k, 3), from (m, k, 3) seen ones.

    Starts from the first frame that shows every marker and averages the others onto it twice
    (generalised Procrustes); the centroid is zero.

    Raises
    ------
    CalibrationRefused
        No frame shows all markers, or they lie on a line.
    """
    full = np.flatnonzero(np.isfinite(positions).all(axis=(1, 2)))
    if full.size == 0:
        raise CalibrationRefused(
            "plate: no moment shows all its markers; hold it where all are seen"
        )
    template: Array = positions[full[0]] - positions[full[0]].mean(axis=0)
    if is_line(template):
        raise CalibrationRefused("plate: its markers lie on one line; move one at least 3 cm aside")
    for _ in range(2):
        q, t, _ = rigid_fit(template, positions)
        local = rotation.rotate(rotation.conjugate(q)[:, None], positions - t[:, None])
        template = np.nanmedian(local, axis=0)
        template -= template.mean(axis=0)
    return template


def marked_parts(settings: CalibrationSettings, chain: Chain) -> list[str]:
    """Return the body parts of the chain that rig.toml gives markers or a rigid body for."""
    known = {*settings.markers, *settings.rigid_bodies}
    return [part for part in body_parts(chain) if part is not None and part in known]
