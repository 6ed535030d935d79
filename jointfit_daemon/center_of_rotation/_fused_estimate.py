"""Robust fusion of several estimates of one center.

Each estimate is weighted by its information matrix. In a direction in which one estimate is
uncertain, the other estimates therefore determine the center. The weight of an estimate is reduced
if it differs from the others by more than its covariance allows. If the weight of estimate k is
below 0.5, the result has the flag ``marker_off:k``.
"""

from __future__ import annotations

from math import sqrt
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation._result import CenterEstimate, refusal

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array


TOLERATED = 2.5
"""Threshold κ of the Huber weight. The weight of an estimate is reduced if the distance D_k of
`fuse_centers` exceeds this threshold.
"""
_PASSES = 50


def fuse_centers(estimates: Sequence[CenterEstimate], *, robust: bool = True) -> CenterEstimate:
    r"""Fuse several estimates of one center, for example one for each marker.

    .. math:: I_k = C_k^{-1}, \qquad C = \Big(\sum_k w_k I_k\Big)^{-1}, \qquad
              c = C \sum_k w_k I_k c_k

    where :math:`c_k` is the center of estimate k, :math:`C_k` its covariance, and
    w_k = min(1, κ/D_k)² its weight. κ is `TOLERATED`.
    D_k is the Mahalanobis distance of estimate k from the center fused from the other estimates,
    divided by the square root of the dimension. The information :math:`I_k` is zero along
    unobserved directions. If the squared differences between the estimates are larger than their
    covariances predict, C is multiplied by the ratio of observed to predicted squared difference.

    Parameters
    ----------
    estimates : sequence of CenterEstimate
        Estimates of equal dimension in one parent frame, with independent errors. The error that
        noise of the parent's markers causes is common to all estimates and is not modeled here;
        `RunningSphere` models this error.
    robust : bool
        Whether to reduce the weight of estimates that contradict the others. This requires at least
        three estimates.

    Returns
    -------
    CenterEstimate
        Fused estimate. Refused estimates are not used. The result is refused if all estimates are
        refused, or if they observe fewer than two directions.

    Raises
    ------
    ValueError
        `estimates` is empty.
    """
    if not estimates:
        raise ValueError("no estimates to fuse")
    d = len(estimates[0].center)
    used = [k for k, e in enumerate(estimates) if e.refused is None]
    if not used:
        reasons = "; ".join(dict.fromkeys(e.refused or "" for e in estimates))
        return refusal("several", d, max(e.frames for e in estimates), reasons)

    centers = np.array([estimates[k].center for k in used])
    knowledge = np.array([_information(estimates[k]) for k in used])
    w, robustly = np.ones(len(used)), robust and len(used) > 2

    for _ in range(_PASSES if robustly else 0):
        again = np.array([_weight(i, w, knowledge, centers) for i in range(len(used))])
        done = bool(np.allclose(again, w, atol=1e-6))
        w = 0.5 * (w + again)
        if done:
            break

    return _combine([estimates[k] for k in used], used, w, knowledge, centers)


def _information(estimate: CenterEstimate) -> Array:
    """Return the inverse covariance of an estimate, which is zero along unobserved directions."""
    d = len(estimate.center)
    across = (
        np.linalg.svd(estimate.unseen)[2][len(estimate.unseen) :]
        if len(estimate.unseen)
        else np.eye(d)
    )
    shown = across @ estimate.covariance @ across.T + 1e-18 * np.eye(len(across))
    return np.asarray(across.T @ np.linalg.inv(shown) @ across)


def _observed_directions(total: Array) -> Array:
    """Return the directions in which the total information is not zero, as columns."""
    if total.size == 0:
        return total
    known, axes = np.linalg.eigh(total)
    return np.asarray(axes[:, known > 1e-9 * max(float(known[-1]), 1e-300)])


def _weight(i: int, w: Array, knowledge: Array, centers: Array) -> float:
    """Return the Huber weight of estimate i, from its distance to the center of the others."""
    others = np.where(np.arange(len(w)) == i, 0.0, w)
    total = np.einsum("k,kab->ab", others, knowledge)
    B = _observed_directions(total)
    shown = B.T @ total @ B
    m = B @ np.linalg.solve(shown, B.T @ np.einsum("k,kab,kb->a", others, knowledge, centers))
    own = _observed_directions(B.T @ knowledge[i] @ B)
    if own.shape[1] == 0:
        return 1.0
    P = B @ own
    spread = np.linalg.inv(P.T @ knowledge[i] @ P) + P.T @ B @ np.linalg.inv(shown) @ B.T @ P
    gap = P.T @ (centers[i] - m)
    square = float(gap @ np.linalg.solve(spread, gap)) / len(gap)
    distance = sqrt(max(square, 0.0))  # negative only by rounding, if `spread` is nearly singular

    return min(1.0, TOLERATED / max(distance, 1e-12)) ** 2


def _combine(
    estimates: list[CenterEstimate], names: list[int], w: Array, knowledge: Array, centers: Array
) -> CenterEstimate:
    total = np.einsum("k,kab->ab", w, knowledge)
    B = _observed_directions(total)
    if B.shape[1] == 0:
        reason = "no direction of the center was observable: increase the range of motion"
        return refusal("several", len(total), max(e.frames for e in estimates), reason)

    C = np.linalg.inv(B.T @ total @ B)
    d = len(total)
    m = B @ C @ B.T @ np.einsum("k,kab,kb->a", w, knowledge, centers)
    unseen = np.asarray(np.linalg.svd(B)[0][:, B.shape[1] :].T)
    m = m + unseen.T @ (unseen @ centers.mean(axis=0))
    gaps = centers - m
    D2 = float(np.einsum("k,ka,kab,kb->", w, gaps, knowledge, gaps))
    free = B.shape[1] * (len(w) - 1)
    excess = max(1.0, D2 / free) if free > 0 else 1.0
    first = estimates[0]
    spread = B @ C @ B.T * excess
    radii = np.concatenate([e.radii for e in estimates])
    off = [f"marker_off:{k}" for k, weight in zip(names, w, strict=True) if weight < 0.5]
    bounds = np.array([e.bound for e in estimates])
    errors = [max(e.rms_error, 1e-12) for e in estimates]
    ratio = [b / x if np.isfinite(x) else 1.0 for b, x in zip(bounds, errors, strict=True)]
    rms_error = float(np.sqrt(np.trace(C)))

    return CenterEstimate(
        method="several",
        center=m,
        covariance=(spread + spread.T) / 2.0,
        noise=float(np.median([e.noise for e in estimates])),
        residual=float(np.sqrt(np.mean([e.residual**2 for e in estimates]))),
        radii=radii,
        arc=max(e.arc for e in estimates),
        bound=rms_error * float(np.mean(ratio))
        if len(unseen) == 0 and np.isfinite(bounds).all()
        else (np.inf if len(unseen) else rms_error),
        conditioning=float(np.nanmedian(radii)) / float(np.sqrt(np.linalg.norm(spread, 2))),
        frames=max(e.frames for e in estimates),
        effective_frames=max(e.effective_frames for e in estimates),
        unseen=unseen,
        axis=unseen[0] if len(unseen) == 1 and d == 3 else None,
        flags=(
            *dict.fromkeys(f for e in estimates for f in e.flags if f != "hinge"),
            *off,
            *(("hinge",) if len(unseen) == 1 and d == 3 else ()),
        ),
        refused=None
        if B.shape[1] >= 2
        else first.refused or "only one direction was observable: increase the range of motion",
    )
