"""Circle fit of a stream of points, at constant cost per frame.

Invariant: the result equals the batch fit of all frames with the same weights. Ten sums over the
frames determine the circle and the variance of its residuals. Ten sums over pairs of successive
frames determine the lag-one correlation of the residuals. The sums are plain floats, because a
NumPy call on ten numbers takes longer than the arithmetic.
"""

from __future__ import annotations

from collections import deque
from math import inf, sqrt
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation.planar._circle_estimate import CircleLimits, publish
from jointfit_daemon.center_of_rotation.planar._circle_fit import CircleMethod, circle_of
from jointfit_daemon.center_of_rotation.planar._moments import (
    FARTHEST_M,
    ROUNDING,
    CircleMoments,
    sum_of_squares,
)

if TYPE_CHECKING:
    from jointfit_daemon.center_of_rotation._result import CenterEstimate

Sums = tuple[float, float, float, float, float, float, float, float, float, float]
Kept = tuple[float, float, float]

_NONE: Sums = (0.0,) * 10
_FAR_M = 1.0
_RESUM_FRAMES = 1000
_HUBER = 1.5
_SETTLED_FRAMES = 30
_LEAST_NOISE_M = 1e-4


class RunningCircle:
    """Circle through a stream of points.

    Parameters
    ----------
    forgetting : float
        Factor by which the weight of all earlier frames is multiplied at each new frame, in (0, 1].
        For frames at intervals Δt, the factor exp(-Δt/τ) has the time constant τ.
    window : int, optional
        Number of most recent valid frames that are used. It cannot be combined with forgetting.
    method : str
        ``kasa``, ``pratt``, ``taubin`` or ``hyper``.
    robust : bool
        Whether to apply Huber weights, with a bound of 1.5 standard deviations about the current
        circle.
    limits : CircleLimits, optional
        Acceptance limits of `estimate`.

    Raises
    ------
    ValueError
        `forgetting` is outside (0, 1], `window` is shorter than four frames, or both options are
        used.
    """

    def __init__(
        self,
        *,
        forgetting: float = 1.0,
        window: int | None = None,
        method: CircleMethod = "hyper",
        robust: bool = False,
        limits: CircleLimits | None = None,
    ) -> None:
        if not 0.0 < forgetting <= 1.0:
            raise ValueError(f"forgetting is {forgetting}: a factor in (0, 1] is needed")
        if window is not None and (window < 4 or forgetting < 1.0):
            raise ValueError(
                "a window needs at least four frames and cannot be combined with forgetting"
            )
        self._forgetting, self._method, self._robust = forgetting, method, robust
        self._limits = limits or CircleLimits()
        self._window = window
        self._kept: deque[Kept] = deque()
        self.clear()

    def clear(self) -> None:
        """Discard all frames."""
        self._origin: tuple[float, float] | None = None
        self._sums = self._lagged = _NONE
        self._squares = 0.0
        self._before: Kept = (0.0, 0.0, 0.0)
        self._kept.clear()
        self._aged = 0
        self._circle: tuple[float, float, float] | None = None
        self._noise = 0.0
        self.frames = 0

    def feed(self, x: float, y: float, weight: float = 1.0) -> None:
        """Process the position of the marker in one frame, in the parent's coordinates, m.

        A frame with NaN (missing marker) or without positive weight only advances the time.
        """
        if not (abs(x) < FARTHEST_M and abs(y) < FARTHEST_M and 0.0 < weight < inf):
            # Advance one frame without a measurement.
            mu = self._forgetting
            if mu < 1.0:
                self._sums = _scale_sums(self._sums, mu)
                self._lagged = _scale_sums(self._lagged, mu * mu)
                self._squares *= mu * mu
            self._before = (0.0, 0.0, 0.0)
            if self._window is not None and self._kept and self._kept[-1][2] > 0.0:
                self._kept.append((0.0, 0.0, 0.0))  # a gap separates the frames before and after it
            return

        if self._origin is None:
            self._origin = (x, y)
        if self._robust:
            weight *= self._huber_weight(x, y)
        ox, oy = self._origin
        x, y = x - ox, y - oy
        if x * x + y * y > _FAR_M**2:
            x, y = self._recenter(x, y)
        self._add(x, y, weight)
        self.frames += 1
        if self._window is not None:
            self._slide((x, y, weight))
        if self._robust and self.frames >= _SETTLED_FRAMES:
            # The weight of the next frame is computed from this circle and its noise.
            found = self.circle()
            if found is not None:
                m = self.moments()
                square = found[2] * found[2]
                rest = sum_of_squares(m, found[0] - m.x, found[1] - m.y, square) / (4.0 * square)
                self._circle, self._noise = found, sqrt(max(rest, 0.0))

    def _add(self, x: float, y: float, w: float) -> None:
        mu = self._forgetting
        a, b, c, d, e, f, g, h, i, j = self._sums
        z = x * x + y * y
        wx, wy, wz = w * x, w * y, w * z
        self._sums = (
            mu * a + wz * z,
            mu * b + wz * x,
            mu * c + wz * y,
            mu * d + wz,
            mu * e + wx * x,
            mu * f + wx * y,
            mu * g + wy * y,
            mu * h + wx,
            mu * i + wy,
            mu * j + w,
        )
        self._squares = mu * mu * self._squares + w * w
        self._lagged = _add_pair(self._lagged, mu * mu, (x, y, w), self._before)
        self._before = (x, y, w)

    def _slide(self, frame: Kept) -> None:
        """Add a frame to the window, and remove the oldest frame if the window is full.

        After every `_RESUM_FRAMES` removals all sums are recomputed, to limit rounding errors.
        """
        kept = self._kept
        kept.append(frame)
        if self.frames <= (self._window or 0):
            return
        x, y, w = kept.popleft()
        z = x * x + y * y
        gone = (z * z, z * x, z * y, z, x * x, x * y, y * y, x, y, 1.0)
        a = self._sums
        self._sums = tuple(s - w * g for s, g in zip(a, gone, strict=True))  # type: ignore[assignment]  # ten
        self._squares -= w * w
        self._lagged = _add_pair(self._lagged, 1.0, kept[0], (x, y, -w))
        self.frames -= 1
        while kept and kept[0][2] == 0.0:
            kept.popleft()
        self._aged += 1
        if self._aged < _RESUM_FRAMES:
            return
        self._sums = self._lagged = _NONE
        self._squares, self._before, self._aged = 0.0, (0.0, 0.0, 0.0), 0
        for x, y, w in kept:
            self._add(x, y, w)

    def _recenter(self, x: float, y: float) -> tuple[float, float]:
        """Move the origin to the mean of the frames if the mean is far away; return the new x, y.

        Fourth powers of large coordinates lose digits.
        """
        weight = self._sums[9]
        if weight <= 0.0 or self._origin is None:
            return x, y
        dx, dy = self._sums[7] / weight, self._sums[8] / weight
        if dx * dx + dy * dy < (_FAR_M / 2) ** 2:
            return x, y
        self._sums, self._lagged = (
            _move_origin(self._sums, dx, dy),
            _move_origin(self._lagged, dx, dy),
        )
        bx, by, bw = self._before
        self._before = (bx - dx, by - dy, bw)
        self._kept = deque((kx - dx, ky - dy, kw) for kx, ky, kw in self._kept)
        self._origin = (self._origin[0] + dx, self._origin[1] + dy)

        return x - dx, y - dy

    def moments(self) -> CircleMoments[float]:
        """Return the weighted central moments of the visible frames."""
        zz, zx, zy, _, xx, xy, yy, xb, yb, w = self._sums
        if w <= 0.0 or self._origin is None:
            return CircleMoments(*(0.0,) * 10)
        i = 1.0 / w
        zz, zx, zy, xx, xy, yy = zz * i, zx * i, zy * i, xx * i, xy * i, yy * i
        xb, yb = xb * i, yb * i
        beta, zeta = xb * xb + yb * yb, xx + yy
        cxx, cxy, cyy = xx - xb * xb, xy - xb * yb, yy - yb * yb

        return CircleMoments(
            w,
            w * w / self._squares if self._squares > 0.0 else 0.0,  # 0 if all weights have decayed
            self._origin[0] + xb,
            self._origin[1] + yb,
            cxx,
            cxy,
            cyy,
            zx - xb * zeta - 2.0 * (cxx * xb + cxy * yb),
            zy - yb * zeta - 2.0 * (cxy * xb + cyy * yb),
            zz
            - 4.0 * (xb * zx + yb * zy)
            + 4.0 * (xb * xb * xx + 2.0 * xb * yb * xy + yb * yb * yy)
            + 2.0 * beta * zeta
            - 3.0 * beta * beta,
        )

    def circle(self) -> tuple[float, float, float] | None:
        """Return center x, y and radius, m, without `temper` and acceptance limits.

        The result is None if the frames do not determine a circle.
        """
        m = self.moments()
        z = m.xx + m.yy
        if m.effective <= 3.0 or m.xx * m.yy - m.xy * m.xy <= ROUNDING * z * z:
            return None
        found = circle_of(m, self._method)
        if found is None:
            return None
        a, b, square = found
        return m.x + a, m.y + b, sqrt(square)

    def estimate(self) -> CenterEstimate:
        """Return center, covariance, predicted error and acceptance from all frames.

        This method never raises an error. Without a usable center, the estimate is refused with
        cause and remedy.
        """
        return publish(
            self.moments(),
            self._residual_product,
            method=self._method,
            frames=self.frames,
            limits=self._limits,
        )

    def _residual_product(self, a: float, b: float, square: float) -> float:
        """Return the mean product of the radial residuals of successive frames about (a, b), m²."""
        zz, zx, zy, z, xx, xy, yy, x, y, w = self._lagged
        if w <= 0.0:
            return 0.0
        weight = self._sums[9]
        a, b = a + self._sums[7] / weight, b + self._sums[8] / weight
        c = a * a + b * b - square
        total = (
            zz
            + 4.0 * (a * a * xx + 2.0 * a * b * xy + b * b * yy)
            + c * c * w
            - 4.0 * (a * zx + b * zy)
            + 2.0 * c * (z - 2.0 * (a * x + b * y))
        )

        return total / (4.0 * square * w)

    def _huber_weight(self, x: float, y: float) -> float:
        if self._circle is None:
            return 1.0
        cx, cy, radius = self._circle
        off = abs(sqrt((x - cx) ** 2 + (y - cy) ** 2) - radius)
        allowed = _HUBER * max(self._noise, _LEAST_NOISE_M)
        return 1.0 if off <= allowed else allowed / off


def _scale_sums(sums: Sums, factor: float) -> Sums:
    return tuple(factor * s for s in sums)  # type: ignore[return-value]  # ten in, ten out


def _add_pair(sums: Sums, mu: float, now: Kept, before: Kept) -> Sums:
    """Return `sums` times `mu`, plus the symmetrized products of two successive frames."""
    x, y, w = now
    u, v, weight = before
    a, b, c, d, e, f, g, h, i, j = sums
    w *= weight
    z, r = x * x + y * y, u * u + v * v
    half = 0.5 * w

    return (
        mu * a + w * z * r,
        mu * b + half * (z * u + r * x),
        mu * c + half * (z * v + r * y),
        mu * d + half * (z + r),
        mu * e + w * x * u,
        mu * f + half * (x * v + u * y),
        mu * g + w * y * v,
        mu * h + half * (x + u),
        mu * i + half * (y + v),
        mu * j + w,
    )


def _move_origin(sums: Sums, dx: float, dy: float) -> Sums:
    """Return the sums about an origin that is moved by (dx, dy).

    Every sum is a sum of products of two elements of (z, x, y, 1). The move multiplies the vector
    (z, x, y, 1) by a matrix T, and the matrix M of the sums becomes T M Tᵀ.
    """
    zz, zx, zy, z, xx, xy, yy, x, y, w = sums
    M = np.array([[zz, zx, zy, z], [zx, xx, xy, x], [zy, xy, yy, y], [z, x, y, w]])
    T = np.eye(4)
    T[0, 1:] = (-2.0 * dx, -2.0 * dy, dx * dx + dy * dy)
    T[1, 3], T[2, 3] = -dx, -dy
    N = T @ M @ T.T
    rows, columns = np.triu_indices(4)
    upper = {(int(r), int(c)): float(N[r, c]) for r, c in zip(rows, columns, strict=True)}
    order = ((0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (2, 2), (1, 3), (2, 3), (3, 3))

    return tuple(upper[key] for key in order)  # type: ignore[return-value]  # ten
