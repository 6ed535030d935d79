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

from jointfit_daemon.calibration.refused import CalibrationRefused, unknown_name
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.trial import CalibrationSettings, OpticalTrack

Mask = NDArray[np.bool_]

MIN_MARKERS = 3
MIN_WIDTH_M = 0.006
"""Least RMS width of a cluster across its longest line; narrower is taken for a line."""
MIN_WIDTH_SHARE = 0.08
"""The same as a share of the length: it bounds how far the turn about that line is amplified."""
MAX_BRIDGE = 60
"""Longest run of frames with a marker missing that is bridged by its neighbours."""
MAX_FIT_RMS_M = 0.03
"""A frame that fits worse has markers swapped or mislabelled, not skin motion."""
MIN_SEEN_STATIC = 20
"""Frames in which a marker must be seen while still."""

_BODY_POINTS = 0.1 / np.sqrt(3.0) * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])


@dataclass(frozen=True, slots=True)
class Cluster:
    """One body part as it stood in the static pose."""

    name: str
    markers: tuple[str, ...]
    """Names in the stream; empty where a rigid body stands for the part."""
    body: str | None
    """Name of the rigid body in the stream, or None."""
    template: Array
    """Marker positions minus `origin`, static world, m, shape (k, 3). A rigid body has four
    virtual points 0.1 m around its origin, so that every later step is the same for both."""
    origin: Array
    """Centroid of the markers (or origin of the body), static world, m, shape (3,)."""
    q_body: Array
    """q_static-world_body of the rigid body; the identity for markers."""


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


def visible(x: Array) -> Mask:
    """Tell which rows (last axis) are whole, without any NaN."""
    return np.asarray(np.isfinite(x).all(axis=-1), dtype=np.bool_)


def rigid_fit(
    template: Array, positions: Array, weights: Array | None = None
) -> tuple[Array, Array, Array]:
    r"""Fit one rigid motion per frame to whatever markers are visible.

    .. math:: \min_{R,t} \sum_k w_k |R a_k + t - y_k|^2

    by the singular values of the weighted cross moment (Kabsch 1976; algorithms C1), all frames at
    once.

    Parameters
    ----------
    template : ndarray, shape (k, 3) or (m, k, 3)
        Marker positions on the body, m; one set for all frames or one each.
    positions : ndarray, shape (m, k, 3)
        Markers seen, m; NaN where not.
    weights : ndarray, shape (k,), optional
        Non-negative; equal if None.

    Returns
    -------
    q, t, rms : ndarray, shapes (m, 4), (m, 3), (m,)
        Rotation, image of the template's zero (m) and RMS distance from the fit (m). NaN in frames
        with fewer than three visible markers or with all visible ones on a line.
    """
    seen = visible(positions)
    w = seen * (np.ones(template.shape[-2]) if weights is None else weights)
    template = np.broadcast_to(template, positions.shape)
    y = np.where(seen[..., None], positions, 0.0)
    total = np.maximum(w.sum(axis=1), 1e-12)[:, None]
    a_mean, y_mean = (np.einsum("mk,mki->mi", w, x) / total for x in (template, y))
    a = template - a_mean[:, None]
    H = np.einsum("mk,mki,mkj->mij", w, a, y - y_mean[:, None])
    U, _, Vt = np.linalg.svd(H)
    V, Ut = np.swapaxes(Vt, 1, 2), np.swapaxes(U, 1, 2)
    V[:, :, 2] *= np.linalg.det(V @ Ut)[:, None]
    R = V @ Ut
    t = y_mean - np.einsum("mij,mj->mi", R, a_mean)
    gap = np.einsum("mij,mkj->mki", R, template) + t[:, None] - y
    rms = np.sqrt((w * (gap**2).sum(axis=-1)).sum(axis=1) / total[:, 0])
    bad = ~_usable(template[0], seen) if len(template) else ~seen.any(axis=1)
    q = rotation.from_matrix(R)
    q[bad], t[bad], rms[bad] = np.nan, np.nan, np.nan
    return q, t, rms


def steady_fit(template: Array, positions: Array) -> tuple[Array, Array, Array]:
    """Fit as `rigid_fit`, without jumps where single markers come and go.

    On skin every marker is some millimetres off its place, and the pose would jump when one is
    hidden. So frames that miss a marker are fitted to where the markers were on the body in the
    nearest whole frames, interpolated in time, if those are at most `MAX_BRIDGE` frames away.
    """
    q, t, rms = rigid_fit(template, positions)
    whole = visible(positions).all(axis=1)
    full, part = np.flatnonzero(whole), np.flatnonzero(~whole & np.isfinite(rms))
    if full.size < 2 or part.size == 0:
        return q, t, rms
    i = np.clip(np.searchsorted(full, part), 1, full.size - 1)
    before, after = full[i - 1], full[i]
    near = (before < part) & (part < after) & (after - before <= MAX_BRIDGE)
    part, before, after = part[near], before[near], after[near]
    share = ((part - before) / (after - before))[:, None, None]
    ends = np.concatenate((before, after))
    local = rotation.rotate(
        rotation.conjugate(q[ends])[:, None], positions[ends] - t[ends][:, None]
    )
    moved = (1.0 - share) * local[: len(part)] + share * local[len(part) :]
    if part.size:
        q[part], t[part], rms[part] = rigid_fit(moved, positions[part])
    return q, t, rms


def _usable(template: Array, seen: Mask) -> Mask:
    """Tell per frame whether the visible markers are three or more and not on a line."""
    patterns, which = np.unique(seen, axis=0, return_inverse=True)
    fit = [np.count_nonzero(p) >= MIN_MARKERS and not is_line(template[p]) for p in patterns]
    return np.array(fit, dtype=bool)[np.ravel(which)]


def is_line(points: Array) -> bool:
    """Tell whether points, m, shape (k, 3), lie too near one line to show turns about it."""
    s = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    return bool(s[1] < max(MIN_WIDTH_M, MIN_WIDTH_SHARE * s[0]))


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
