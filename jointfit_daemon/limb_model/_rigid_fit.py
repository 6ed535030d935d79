"""Rigid motions of marker clusters, fitted to the visible markers of every frame.

NaN marks an invisible marker, which a fit ignores. The results of a frame without a fit are NaN.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array


Mask = NDArray[np.bool_]

MIN_MARKERS = 3
"""Smallest number of visible markers of a rigid fit."""

MIN_WIDTH_M = 0.006
"""Smallest RMS width of a cluster perpendicular to its longest line, m. A narrower cluster counts
as a line.
"""

MIN_WIDTH_SHARE = 0.08
"""Smallest RMS width as a fraction of the RMS length of the cluster. It limits the rotation error
about the longest line.
"""

MAX_BRIDGE = 60
"""Largest number of frames from one complete frame to the next between which `steady_fit`
interpolates.
"""

MAX_FIT_RMS_M = 0.03
"""RMS residual, m, above which the markers count as swapped or mislabeled. Soft-tissue artefact
causes smaller residuals.
"""


def visible(x: Array) -> Mask:
    """Return a mask, shape (...), of the rows without NaN in an array of shape (..., k)."""
    return np.asarray(np.isfinite(x).all(axis=-1), dtype=np.bool_)


def rigid_fit(
    template: Array, positions: Array, weights: Array | None = None
) -> tuple[Array, Array, Array]:
    r"""Fit one rigid motion per frame to the visible markers.

    .. math:: \min_{R,t} \sum_k w_k |R a_k + t - y_k|^2

    The solution is the singular value decomposition of the weighted cross moment (Kabsch 1976), for
    all frames at once.

    Parameters
    ----------
    template : ndarray, shape (k, 3) or (m, k, 3)
        Marker positions on the body, m, either one set for all frames or one set per frame.
    positions : ndarray, shape (m, k, 3)
        Measured marker positions, m; NaN if not visible.
    weights : ndarray, shape (k,), optional
        Non-negative weights; equal by default.

    Returns
    -------
    q, t, rms : ndarray, shapes (m, 4), (m, 3), (m,)
        Rotation, measured position of the template's origin (m), and RMS residual (m). They are NaN
        in frames with fewer than three visible markers, or if all visible markers are on a line.
    """
    seen = visible(positions)
    w = seen * (np.ones(template.shape[-2]) if weights is None else weights)
    template = np.broadcast_to(template, positions.shape)

    y = np.where(seen[..., None], positions, 0.0)
    total = np.maximum(w.sum(axis=1), 1e-12)[:, None]
    a_mean, y_mean = (np.einsum("mk,mki->mi", w, x) / total for x in (template, y))
    a = template - a_mean[:, None]

    # R = V diag(1, 1, det) U^T from the cross moment; t is computed from the centroids.
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
    """Fit like `rigid_fit`, without steps in the pose when single markers disappear or reappear.

    Soft tissue moves every marker some millimeters, so the pose would step when a marker is hidden.
    The fit of a frame with missing markers therefore uses another template: marker positions on the
    body that are interpolated in time between the nearest complete frames. If these two frames are
    more than `MAX_BRIDGE` frames apart, the pose of `rigid_fit` is used.
    """
    q, t, rms = rigid_fit(template, positions)
    whole = visible(positions).all(axis=1)
    full, part = np.flatnonzero(whole), np.flatnonzero(~whole & np.isfinite(rms))
    if full.size < 2 or part.size == 0:
        return q, t, rms

    # Complete frames before and after each incomplete frame.
    i = np.clip(np.searchsorted(full, part), 1, full.size - 1)
    before, after = full[i - 1], full[i]
    near = (before < part) & (part < after) & (after - before <= MAX_BRIDGE)
    part, before, after = part[near], before[near], after[near]

    # Marker positions on the body, interpolated between the complete frames.
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
    """Return the frames with three or more visible markers that are not on a line."""
    patterns, which = np.unique(seen, axis=0, return_inverse=True)
    fit = [np.count_nonzero(p) >= MIN_MARKERS and not is_line(template[p]) for p in patterns]
    return np.array(fit, dtype=bool)[np.ravel(which)]


def is_line(points: Array) -> bool:
    """Return whether points are too close to a line to fit a rotation about this line.

    The points have shape (k, 3), m.
    """
    s = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    return bool(s[1] < max(MIN_WIDTH_M, MIN_WIDTH_SHARE * s[0]))
