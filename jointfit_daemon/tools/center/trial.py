"""From a marker trial to centers of rotation: the parent's coordinates, windows, places.

Law: pure. Coordinates of the parent come from its own markers: origin in their middle, x from the
first to the second, z across the plane of the first three (in a plane: y across x). So they are the
same in every trial of one placement of markers.
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
    from jointfit_daemon.files.mocap import Axis, MarkerTrial


CHI2_95 = {1: 3.841, 2: 5.991, 3: 7.815}
"""Squared semi-axes of the 95 % ellipsoid over the variances, by the number of dimensions."""
STILL_M = 0.005
"""RMS movement of the child's markers below which there is no center, m."""
_SEGMENT_M = (0.005, 2.0)
"""How far apart the markers of one segment may be, m."""
_LEAST_PLANAR = 2
_FEWEST_FRAMES = 3


class Unanswerable(ValueError):  # noqa: N818 - named for what happened
    """The question cannot be asked of this trial; the message says what to change."""


@dataclass(frozen=True, slots=True)
class Reduced:
    """Child markers in the parent's coordinates, and how to come back."""

    movement: Movement
    """Of all frames."""
    rms: float
    """How rigid the parent's markers are: RMS distance from the fit, m."""
    poses: BodyPoses
    """The parent in the world (z up); in a plane its turn about the plane's normal."""
    basis: Array
    """Takes parent coordinates (d,) to those of `poses` (3,): the identity, or the plane."""

    def to_world(self, center: Array) -> Array:
        """Return where a point of the parent is at the parent's mean pose, m, shape (3,)."""
        known = visible(self.poses.q) & visible(self.poses.t)
        mean = BodyPoses(
            rotation.average(self.poses.q[known])[None],
            self.poses.t[known].mean(axis=0)[None],
        )
        return np.asarray(mean.to_world(self.basis @ center)[0])


@dataclass(frozen=True, slots=True)
class Answer:
    """What one stretch of the trial says."""

    start_s: float
    end_s: float
    estimate: CenterEstimate
    world: Array
    """The center at the parent's mean pose of the trial, m, file's axes, shape (3,)."""

    @property
    def semi_axes(self) -> Array:
        """Return the semi-axes of the 95 % ellipsoid, m, longest first; inf where unseen."""
        unseen = len(self.estimate.unseen)
        variances = np.linalg.eigvalsh(self.estimate.covariance)[unseen:]
        told = self.estimate.within95
        scale = CHI2_95[max(1, len(variances))] if told is None else told
        seen = np.sqrt(scale * np.maximum(variances[::-1], 0.0))
        return np.concatenate((np.full(unseen, np.inf), seen))


def reduce(
    trial: MarkerTrial, parent: Sequence[str], markers: Sequence[str], plane: Axis | None
) -> Reduced:
    """Take the child's markers to the parent's coordinates.

    Parameters
    ----------
    trial : MarkerTrial
    parent, markers : sequence of str
        Names; three or more of the parent in space, two in a plane.
    plane : {"x", "y", "z"} or None
        The file's axis across the plane of the movement; None: in space.

    Raises
    ------
    Unanswerable
        Too few markers, a parent on a line, or one never seen whole.
    """
    if both := sorted(set(parent) & set(markers)):
        raise Unanswerable(f"{', '.join(both)}: named as parent and as child; take out of one")
    _check_parent(trial, parent, MIN_MARKERS if plane is None else _LEAST_PLANAR)
    interval = 1.0 / trial.trajectories.rate_hz
    seen, child = trial.points(parent), trial.points(markers)
    if plane is not None:
        return _reduce_planar(seen, child, plane_of(trial.direction(plane)), interval)
    template = moving_template(seen)
    if is_line(template[:MIN_MARKERS]):
        raise Unanswerable(
            f"--parent: the first three, {', '.join(parent[:MIN_MARKERS])}, lie on a line: put"
            " another one among the first three"
        )
    template = template @ _own_axes(template)
    poses, rms = _poses(template, seen)
    if not visible(poses.t).any():
        raise Unanswerable(
            f"--parent: {', '.join(parent)} are not rigid in any frame (more than"
            f" {1000 * MAX_FIT_RMS_M:g} mm RMS off their shape): name markers of one segment"
        )
    other = None
    if len(markers) >= MIN_MARKERS and visible(child).all(axis=1).any():
        seen_at_all = child[visible(child).any(axis=1)]
        middle = np.nanmean(seen_at_all, axis=1, keepdims=True)
        shape = np.nanmedian(seen_at_all - middle, axis=0)
        other = None if is_line(shape) else _poses(moving_template(child), child)[0]
    movement = Movement(poses.to_body(child), poses, other, template, interval=interval)
    return Reduced(movement, rms, poses, np.eye(3))


def _check_parent(trial: MarkerTrial, parent: Sequence[str], least: int) -> None:
    if len(set(parent)) < least:
        more = " or, for a movement in a plane, two and --plane" if least == MIN_MARKERS else ""
        raise Unanswerable(f"--parent: {len(set(parent))} markers, {least} are needed{more}")
    seen = visible(trial.points(parent))
    if not seen.all(axis=1).any():
        counts = ", ".join(f"{m} {n}" for m, n in zip(parent, seen.sum(axis=0), strict=True))
        raise Unanswerable(
            f"--parent: no frame shows all of them (frames seen: {counts}): leave out the one seen"
            " least"
        )
    whole = trial.points(parent)[seen.all(axis=1)]
    apart = float(np.ptp(whole[0], axis=0).max())
    if not _SEGMENT_M[0] <= apart <= _SEGMENT_M[1]:
        raise Unanswerable(
            f"--parent: {', '.join(parent)} are {1000 * apart:.3g} mm apart, which no segment is:"
            " the unit that the file states is not the one of its numbers, or the names are wrong"
        )
    if least == MIN_MARKERS and is_line(whole[0]):
        raise Unanswerable(
            f"--parent: {', '.join(parent)} lie on a line: turns about it do not show; add"
            " a marker beside it, or use --plane with two markers"
        )


def _own_axes(template: Array) -> Array:
    """Return the parent's axes as columns, shape (3, 3); see the module."""
    x = template[1] - template[0]
    z = np.cross(x, template[2] - template[0])
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    return np.column_stack((x, np.cross(z, x), z))


def _poses(template: Array, seen: Array) -> tuple[BodyPoses, float]:
    q, t, rms = steady_fit(template, seen)
    wrong = ~(rms <= MAX_FIT_RMS_M)
    q[wrong], t[wrong] = np.nan, np.nan
    good = rms[~wrong]
    return BodyPoses(q, t), float(np.sqrt((good**2).mean())) if good.size else float("nan")


def _reduce_planar(seen: Array, child: Array, basis: Array, interval: float) -> Reduced:
    """Do the same in the plane spanned by `basis`, shape (3, 2), from two parent markers on."""
    flat = seen @ basis
    z = flat[..., 0] + 1j * flat[..., 1]
    whole = np.flatnonzero(np.isfinite(z).all(axis=1))
    middle = z.mean(axis=1)
    # every frame turned so that x goes from the first marker to the second, then averaged
    turned = (z - middle[:, None]) * np.exp(-1j * np.angle(z[:, 1] - z[:, 0]))[:, None]
    template = turned[whole].mean(axis=0)
    turn = np.angle(((z - middle[:, None]) * template.conj()).sum(axis=1))
    gap = np.abs((z - middle[:, None]) * np.exp(-1j * turn)[:, None] - template)[whole]
    marker = child @ basis
    w = (marker[..., 0] + 1j * marker[..., 1] - middle[:, None]) * np.exp(-1j * turn)[:, None]
    normal = np.cross(basis[:, 0], basis[:, 1])
    poses = BodyPoses(rotation.exp(turn[:, None] * normal), seen.mean(axis=1))
    movement = Movement(np.stack((w.real, w.imag), axis=-1), interval=interval)
    return Reduced(movement, float(np.sqrt((gap**2).mean())), poses, basis)


def answers(
    trial: MarkerTrial, reduced: Reduced, method: str, window_s: float | None
) -> Iterator[Answer]:
    """Yield the answer of the whole trial, or of one window after the other.

    Raises
    ------
    Unanswerable
        The method is unknown, or needs what a marker trial does not hold.
    """
    movement = reduced.movement
    _check_method(method, movement)
    points = movement.points
    if points is None:  # a movement of `reduce` has points
        raise Unanswerable("no markers")
    size = len(points)
    if window_s is not None:
        size = max(_FEWEST_FRAMES, round(window_s / movement.interval))
    t_s = trial.trajectories.t_s
    for first in range(0, len(points), size):
        part = slice(first, min(first + size, len(points)))
        if part.stop - first < min(size, len(points)) // 2:
            return  # a rest of less than half a window says nothing of its own
        found = _moved_enough(estimate_center(_cut(movement, part), method), points[part])
        world = trial.to_file(reduced.to_world(found.center))
        yield Answer(float(t_s[first]), float(t_s[part.stop - 1]), found, world)


def _moved_enough(found: CenterEstimate, points: Array) -> CenterEstimate:
    """Refuse what the parent's own noise, turned by the lever to the child, may have drawn."""
    seen = visible(points)
    if not seen.any():
        return found
    away = np.where(seen[..., None], points, 0.0)
    counts = np.maximum(seen.sum(axis=0), 1)
    away = np.where(seen[..., None], points - away.sum(axis=0) / counts[:, None], 0.0)
    moved = float(np.sqrt(((away**2).sum(axis=(0, 2)) / counts).max()))
    if moved >= STILL_M:
        return found
    why = f"the markers moved {1000 * moved:.1f} mm RMS only, which noise of the parent may be"
    return replace(found, refused=f"{why}: move the joint through at least 30°")


def _check_method(method: str, movement: Movement) -> None:
    if method == "auto":
        return
    if method not in METHODS:
        hint = did_you_mean(method, METHODS) or "known:"
        about = "\n".join(f"  {m.name:16}{m.about}" for m in METHODS.values())
        raise Unanswerable(f"--method: no method {method!r}; {hint}\n{about}")
    chosen = METHODS[method]
    if "angles" in chosen.needs:
        raise Unanswerable(
            f"--method {method} needs the child's angle from inertial sensors: a marker trial has"
            " none; use jointfit calibrate, or another method"
        )
    dimensions = 0 if movement.points is None else movement.points.shape[-1]
    if not chosen.planar and dimensions == len("xy"):
        raise Unanswerable(f"--method {method} works in space: leave out --plane")
    if "child" in chosen.needs and movement.child is None:
        raise Unanswerable(
            f"--method {method} needs at least three child markers, not on a line: name more with"
            " --markers, or use sphere"
        )


def _cut(movement: Movement, part: slice) -> Movement:
    def bodies(poses: BodyPoses | None) -> BodyPoses | None:
        return None if poses is None else BodyPoses(poses.q[part], poses.t[part])

    return Movement(
        None if movement.points is None else movement.points[part],
        bodies(movement.parent),
        bodies(movement.child),
        movement.parent_markers,
        interval=movement.interval,
    )
