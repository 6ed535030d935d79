"""Centres of rotation from a marker trial: parent frame, estimates by window, world positions.

The parent frame is defined by the parent's markers, so it is the same in all trials with the same
marker placement. Its origin is the mean of these markers, and x extends from the first to the
second marker. In space, z is normal to the plane of the first three markers. For planar movement,
y is normal to x.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.anatomy import moving_template
from jointfit_daemon.center_of_rotation import METHODS, BodyPoses, Movement, estimate_center
from jointfit_daemon.center_of_rotation.planar import plane_of
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import MAX_FIT_RMS_M, MIN_MARKERS, is_line, steady_fit, visible
from jointfit_daemon.nearest_name import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation import CenterEstimate
    from jointfit_daemon.files.axes import Axis
    from jointfit_daemon.files.mocap import MarkerTrial


CHI2_95 = {1: 3.841, 2: 5.991, 3: 7.815}
"""95 % quantile of the chi-squared distribution, by degrees of freedom. The squared semi-axis of a
95 % ellipsoid is this quantile times the variance along the semi-axis."""
STILL_M = 0.005
"""RMS movement of the child marker that moves most, m, below which the centre is unobservable."""
_SEGMENT_M = (0.005, 2.0)
"""Plausible extent of the markers of one segment, m; other values indicate a wrong unit."""
LEAST_PLANAR = 2
"""Smallest number of parent markers for an estimate in a plane."""
_FEWEST_FRAMES = 3
"""Smallest number of frames of a window: three points define a circle."""
_EXCHANGE_RAD = 2.5
"""Rotation of a planar parent between two frames, rad. A larger rotation indicates that the names
of two markers were exchanged."""
_EXCHANGE_S = 0.1
"""Longest time between two frames that are checked for exchanged names, s."""


class UnsuitableTrialError(ValueError):
    """The trial does not support the requested estimate; the message states the remedy."""


@dataclass(frozen=True, slots=True)
class ParentFrameMotion:
    """Child markers in the parent's coordinates, and the transformation back to the world."""

    movement: Movement
    """Positions of the child markers in the parent frame in all frames of the trial, m."""
    rms: float
    """RMS residual of the rigid fit to the parent markers, m."""
    poses: BodyPoses
    """Parent poses in the world (z up). For planar movement, the rotation is about the normal only.
    """
    basis: Array
    """Matrix from parent coordinates (d,) to the coordinates of `poses` (3,); d is the number of
    dimensions. In space the matrix is the identity; for planar movement it is the basis of the
    plane."""
    template: Array
    """Parent markers in the parent frame, m, shape (number of markers, d)."""

    def to_world(self, center: Array) -> Array:
        """Return the world position of a point, m, shape (3,), at the mean parent pose.

        `center` is the point in parent coordinates, m, shape (d,).
        """
        known = visible(self.poses.q) & visible(self.poses.t)
        mean = BodyPoses(
            rotation.average(self.poses.q[known])[None], self.poses.t[known].mean(axis=0)[None]
        )
        return np.asarray(mean.to_world(self.basis @ center)[0])


@dataclass(frozen=True, slots=True)
class WindowEstimate:
    """Estimate of the centre from one window of the trial."""

    start_s: float
    end_s: float
    estimate: CenterEstimate
    world: Array
    """Position of the centre, m, shape (3,), at the mean parent pose, in the axes of the file."""

    @property
    def semi_axes(self) -> Array:
        """Return the semi-axes of the 95 % ellipsoid, m, shape (d,), longest first.

        A semi-axis along an unobservable direction is infinite.
        """
        unseen = len(self.estimate.unseen)
        variances = np.linalg.eigvalsh(self.estimate.covariance)[unseen:]
        within95 = self.estimate.within95
        scale = CHI2_95[max(1, len(variances))] if within95 is None else within95
        seen = np.sqrt(scale * np.maximum(variances[::-1], 0.0))
        return np.concatenate((np.full(unseen, np.inf), seen))


def reduce(
    trial: MarkerTrial,
    parent: Sequence[str],
    markers: Sequence[str],
    plane: Axis | None,
    option: str = "--parent",
) -> ParentFrameMotion:
    """Transform the child markers to the parent frame.

    Parameters
    ----------
    trial : MarkerTrial
    parent, markers : sequence of str
        Marker names. The parent needs at least three markers in space, and two in a plane.
    plane : {"x", "y", "z"} or None
        Axis of the file normal to the plane of movement; None for spatial movement.
    option : str
        Command-line option that named the parent markers, for error messages.

    Raises
    ------
    UnsuitableTrialError
        The parent markers are too few, are collinear, are never visible together, do not move
        rigidly, or have exchanged names.
    """
    if both := sorted(set(parent) & set(markers)):
        raise UnsuitableTrialError(
            f"{', '.join(both)}: named in --parent and in --markers; remove them from one option"
        )

    _check_parent(trial, parent, MIN_MARKERS if plane is None else LEAST_PLANAR, option)
    interval = 1.0 / trial.trajectories.rate_hz
    seen, child = trial.points(parent), trial.points(markers)
    if plane is not None:
        basis = plane_of(trial.direction(plane))
        _check_planar_parent(seen @ basis, trial, parent, option)
        reduced = _reduce_planar(seen, child, basis, interval)
        _check_rigid(reduced.poses.q, parent, option)
        return _with_residuals(reduced, trial, markers)

    template = moving_template(seen)
    if is_line(template[:MIN_MARKERS]):
        raise UnsuitableTrialError(
            f"{option}: the first three markers, {', '.join(parent[:MIN_MARKERS])}, are collinear:"
            " list a marker off the line among the first three"
        )

    # Axes of the parent frame as columns.
    x = template[1] - template[0]
    z = np.cross(x, template[2] - template[0])
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    template = template @ np.column_stack((x, np.cross(z, x), z))
    poses, rms = _poses(template, seen)
    _check_rigid(poses.q, parent, option)
    other = None
    if len(markers) >= MIN_MARKERS and visible(child).all(axis=1).any():
        seen_at_all = child[visible(child).any(axis=1)]
        middle = np.nanmean(seen_at_all, axis=1, keepdims=True)
        shape = np.nanmedian(seen_at_all - middle, axis=0)
        other = None if is_line(shape) else _poses(moving_template(child), child)[0]

    movement = Movement(poses.to_body(child), poses, other, template, interval=interval)
    reduced = ParentFrameMotion(movement, rms, poses, np.eye(3), template)
    return _with_residuals(reduced, trial, markers)


def _with_residuals(
    reduced: ParentFrameMotion, trial: MarkerTrial, markers: Sequence[str]
) -> ParentFrameMotion:
    residuals, names = trial.residuals(markers), tuple(markers)
    movement = replace(reduced.movement, residuals=residuals, names=names)
    return replace(reduced, movement=movement)


def _check_parent(trial: MarkerTrial, parent: Sequence[str], least: int, option: str) -> None:
    if len(set(parent)) < least:
        more = " (2 for a planar movement, with --plane)" if least == MIN_MARKERS else ""
        raise UnsuitableTrialError(
            f"{option}: {len(set(parent))} markers, expected at least {least}{more}"
        )

    seen = visible(trial.points(parent))
    if not seen.all(axis=1).any():
        counts = ", ".join(f"{m} {n}" for m, n in zip(parent, seen.sum(axis=0), strict=True))
        raise UnsuitableTrialError(
            f"{option}: no frame contains all markers (frames by marker: {counts}): omit the marker"
            " with the fewest frames"
        )

    whole = trial.points(parent)[seen.all(axis=1)]
    apart = float(np.ptp(whole[0], axis=0).max())
    if not _SEGMENT_M[0] <= apart <= _SEGMENT_M[1]:
        raise UnsuitableTrialError(
            f"{option}: {', '.join(parent)} are {1000 * apart:.3g} mm apart, expected 5 mm to"
            " 2 m: check the unit stated in the file, and the marker names"
        )

    if least == MIN_MARKERS and is_line(whole[0]):
        raise UnsuitableTrialError(
            f"{option}: {', '.join(parent)} are collinear, so rotation about the line is"
            " unobservable: add a marker off the line, or use --plane with two markers"
        )


def _check_planar_parent(
    flat: Array, trial: MarkerTrial, parent: Sequence[str], option: str
) -> None:
    """Raise an error if the names of the first two parent markers are exchanged in the trial."""
    along = flat[:, 1] - flat[:, 0]
    whole = np.flatnonzero(np.isfinite(flat).all(axis=(1, 2)))
    step = np.angle(np.exp(1j * np.diff(np.arctan2(along[whole, 1], along[whole, 0]))))
    t_s = trial.trajectories.t_s[whole]
    turned = np.flatnonzero((np.abs(step) > _EXCHANGE_RAD) & (np.diff(t_s) <= _EXCHANGE_S))
    if turned.size:
        raise UnsuitableTrialError(
            f"{option}: {parent[0]} and {parent[1]} exchange places at {t_s[turned[0] + 1]:.2f} s:"
            " correct their names in the file"
        )


def _check_rigid(q: Array, parent: Sequence[str], option: str) -> None:
    if not visible(q).any():
        raise UnsuitableTrialError(
            f"{option}: {', '.join(parent)} do not move rigidly in any frame"
            f" (residual above {1000 * MAX_FIT_RMS_M:g} mm RMS): list markers of one segment"
        )


def _poses(template: Array, seen: Array) -> tuple[BodyPoses, float]:
    q, t, rms = steady_fit(template, seen)
    wrong = ~(rms <= MAX_FIT_RMS_M)
    q[wrong], t[wrong] = np.nan, np.nan
    good = rms[~wrong]
    return BodyPoses(q, t), float(np.sqrt((good**2).mean())) if good.size else float("nan")


def _reduce_planar(seen: Array, child: Array, basis: Array, interval: float) -> ParentFrameMotion:
    """Transform child markers to the parent frame in the plane spanned by `basis`, shape (3, 2)."""
    flat = seen @ basis
    z = flat[..., 0] + 1j * flat[..., 1]
    whole = np.flatnonzero(np.isfinite(z).all(axis=1))
    middle = z.mean(axis=1)
    # The template is the median of all complete frames. Each frame is first rotated so that the
    # direction from the first to the second marker is the x axis.
    turned = (z - middle[:, None]) * np.exp(-1j * np.angle(z[:, 1] - z[:, 0]))[:, None]
    template = np.median(turned[whole].real, axis=0) + 1j * np.median(turned[whole].imag, axis=0)
    template -= template.mean()
    turn = np.angle(((z - middle[:, None]) * template.conj()).sum(axis=1))
    gap = np.abs((z - middle[:, None]) * np.exp(-1j * turn)[:, None] - template)
    rms = np.sqrt((gap**2).mean(axis=1))
    turn[~(rms <= MAX_FIT_RMS_M)] = np.nan

    marker = child @ basis
    w = (marker[..., 0] + 1j * marker[..., 1] - middle[:, None]) * np.exp(-1j * turn)[:, None]
    normal = np.cross(basis[:, 0], basis[:, 1])
    poses = BodyPoses(rotation.exp(turn[:, None] * normal), seen.mean(axis=1))
    movement = Movement(np.stack((w.real, w.imag), axis=-1), interval=interval)
    rigid = rms[rms <= MAX_FIT_RMS_M]
    return ParentFrameMotion(
        movement,
        float(np.sqrt((rigid**2).mean())) if rigid.size else float("nan"),
        poses,
        basis,
        np.column_stack((template.real, template.imag)),
    )


def answers(
    trial: MarkerTrial, reduced: ParentFrameMotion, method: str, window_s: float | None
) -> Iterator[WindowEstimate]:
    """Yield the estimate of the whole trial, or one estimate per window.

    Raises
    ------
    UnsuitableTrialError
        The method is unknown, or needs data that a marker trial does not contain.
    """
    movement = reduced.movement
    _check_method(method, movement)
    points = movement.points
    if points is None:
        raise UnsuitableTrialError("no child markers")

    def within(poses: BodyPoses | None, part: slice) -> BodyPoses | None:
        return None if poses is None else BodyPoses(poses.q[part], poses.t[part])

    size = len(points)
    if window_s is not None:
        size = max(_FEWEST_FRAMES, round(window_s / movement.interval))

    t_s = trial.trajectories.t_s
    for first in range(0, len(points), size):
        part = slice(first, min(first + size, len(points)))
        if part.stop - first < min(size, len(points)) // 2:
            return  # the last part of the trial is shorter than half a window
        window = replace(
            movement,
            points=points[part],
            residuals=None if movement.residuals is None else movement.residuals[part],
            parent=within(movement.parent, part),
            child=within(movement.child, part),
        )
        found = _refuse_small_motion(estimate_center(window, method), points[part])
        world = trial.to_file(reduced.to_world(found.center))
        yield WindowEstimate(float(t_s[first]), float(t_s[part.stop - 1]), found, world)


def _refuse_small_motion(found: CenterEstimate, points: Array) -> CenterEstimate:
    """Refuse an estimate if each child marker moves by less than `STILL_M` RMS.

    Rotational noise of the parent could explain such a small motion.
    """
    seen = visible(points)
    if not seen.any():
        return found

    away = np.where(seen[..., None], points, 0.0)
    counts = np.maximum(seen.sum(axis=0), 1)
    away = np.where(seen[..., None], points - away.sum(axis=0) / counts[:, None], 0.0)
    moved = float(np.sqrt(((away**2).sum(axis=(0, 2)) / counts).max()))
    if moved >= STILL_M:
        return found

    why = f"child marker motion {1000 * moved:.1f} mm RMS, expected at least {1000 * STILL_M:g} mm"
    return replace(found, refused=f"{why}: move the joint through at least 30°")


def _check_method(method: str, movement: Movement) -> None:
    if method == "auto":
        return
    if method not in METHODS:
        hint = did_you_mean(method, METHODS) or "known:"
        about = "\n".join(f"  {m.name:16}{m.about}" for m in METHODS.values())
        raise UnsuitableTrialError(f"--method: no method {method!r}; {hint}\n{about}")

    chosen = METHODS[method]
    if "angles" in chosen.needs:
        raise UnsuitableTrialError(
            f"--method {method} needs inertial angles of the child, which a marker trial does not"
            f' contain: set center_method = "{method}" in [calibration] of rig.toml and run'
            " jointfit calibrate, or use another method"
        )

    dimensions = 0 if movement.points is None else movement.points.shape[-1]
    if not chosen.planar and dimensions == len("xy"):
        raise UnsuitableTrialError(f"--method {method} is spatial only: omit --plane")
    if "child" in chosen.needs and movement.child is None:
        raise UnsuitableTrialError(
            f"--method {method} needs at least three child markers that are not collinear: add some"
            " with --markers, or use sphere"
        )
