"""Rigid motions of marker clusters, fitted to the visible markers of every frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array


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
