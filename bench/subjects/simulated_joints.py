"""Simulated joints: true paths, noisy markers, and frames fitted to the markers.

Invariant: the center is at the origin of the parent frame. All random numbers are from the given
generator.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation import BodyPoses
from jointfit_daemon.center_of_rotation.spatial import spatial_noise
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import rigid_fit

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation import CenterEstimate


CHILD = np.array([[0.05, 0, -0.25], [-0.04, 0.05, -0.3], [0, -0.06, -0.2], [0.06, 0.04, -0.32]])
"""Marker positions on the child segment, m, shape (4, 3)."""
PARENT = np.array([[0.1, 0.1, 0.05], [-0.1, 0.1, 0.04], [0.1, -0.08, 0.06], [-0.1, -0.08, 0.1]])
TEMPLATE_ERROR_M = 0.0003
RADII = (0.30, 0.35, 0.20, 0.28)
OFFSETS = (0.0, 0.25, -0.3, 0.6)
CHI2_95 = {2: 5.991, 3: 7.815}


@dataclass(frozen=True, slots=True)
class Seen:
    """Camera observation of one run."""

    points: Array
    """Child markers in the fitted frame of the parent, m, shape (n, k, 3)."""
    parent: BodyPoses
    child: BodyPoses


def ball_turns(rng: np.random.Generator, rom_deg: float, n: int = 200) -> Array:
    """Return the matrices of random rotations about all axes, shape (n, 3, 3)."""
    h = np.radians(rom_deg) / 2
    a, phi = h * np.sqrt(rng.uniform(size=n)), rng.uniform(0, 2 * np.pi, n)
    vectors = np.stack((a * np.cos(phi), a * np.sin(phi), rng.uniform(-h, h, n)), axis=1)
    return np.asarray(rotation.to_matrix(rotation.exp(vectors)))


def hinge_turns(rom_deg: float, n: int = 200, axis: int = 2) -> Array:
    """Return rotation matrices about one axis, shape (n, 3, 3)."""
    angle = np.linspace(-0.5, 0.5, n) * np.radians(rom_deg)
    return np.asarray(rotation.to_matrix(rotation.exp(angle[:, None] * np.eye(3)[axis])))


def star_turns(rom_deg: float, n: int) -> Array:
    """Return the rotation matrices of a smooth movement in all directions, shape (n, 3, 3)."""
    s = np.linspace(0.0, 2.0 * np.pi, n)
    vectors = np.stack((np.sin(3 * s), np.sin(4 * s + 0.7), np.sin(5 * s + 1.3)), axis=1)
    return np.asarray(rotation.to_matrix(rotation.exp(np.radians(rom_deg) / 2 * vectors)))


def carried(turns: Array, markers: Array = CHILD) -> Array:
    """Return the true paths of markers, m, shape (n, k, 3)."""
    return np.asarray(np.einsum("nij,kj->nki", turns, markers))


def fan(arc_deg: float, n: int = 100) -> Array:
    """Return paths of four markers in a plane at different angles about the joint, m, (n, 4, 2)."""
    theta = np.linspace(0.0, np.radians(arc_deg), n)[:, None] + np.array(OFFSETS)
    return np.asarray(np.array(RADII)[:, None] * np.stack((np.cos(theta), np.sin(theta)), axis=-1))


def watched(
    rng: np.random.Generator,
    turns: Array,
    *,
    markers: Array = CHILD,
    noise: float = 1e-3,
    template_error: float = 0.0,
    frame: Array = PARENT,
) -> Seen:
    """Return an observation of a moving parent and its child by noisy markers."""
    n = len(turns)
    moved = rotation.to_matrix(rotation.exp(rng.normal(0, 0.1, (n, 3))))
    t = rng.normal(0, 0.05, (n, 3))
    above = np.einsum("nij,kj->nki", moved, frame) + t[:, None]
    below = np.einsum("nij,nkj->nki", moved, carried(turns, markers)) + t[:, None]
    above += rng.normal(0, noise, above.shape)
    below += rng.normal(0, noise, below.shape)
    parent = BodyPoses(*rigid_fit(frame, above)[:2])
    template = markers + rng.normal(0, template_error, markers.shape)
    child = BodyPoses(*rigid_fit(template, below)[:2])
    return Seen(parent.to_body(below), parent, child)


def sphere_bound(paths: Array, noise: float) -> float:
    """Return the smallest possible mean squared error of a center from these true paths, m²."""
    u = paths / np.linalg.norm(paths, axis=-1, keepdims=True)
    u = u - u.mean(axis=0)
    return float(np.trace(np.linalg.inv(np.einsum("tja,tjb->ab", u, u)))) * noise**2


def joint_bound(paths: Array, noise: float, frame: Array = PARENT) -> float:
    r"""Return the bound of `sphere_bound` for a parent frame that is fitted to noisy markers, m².

    .. math:: \left[ \sum_t A_t^T S_t^{-1} A_t \right]^{-1}, \qquad A_t = (U_t \; I), \quad
              S_t = σ^2 \left( I + U_t Σ_c U_t^T \right)

    Here the rows of U_t are the unit vectors from the center to the markers in frame t, the columns
    of I belong to the radii, and σ is `noise`. The error of the fitted parent frame displaces the
    center with the covariance σ² Σ_c, in the same way for all markers.
    """
    u = paths / np.linalg.norm(paths, axis=-1, keepdims=True)
    k = u.shape[1]
    shared = spatial_noise(np.zeros(3), frame, 1.0) - np.eye(3)
    together = np.eye(k) + u @ shared @ np.swapaxes(u, 1, 2)
    design = np.concatenate((u, np.broadcast_to(np.eye(k), (len(u), k, k))), axis=2)
    information = (np.swapaxes(design, 1, 2) @ np.linalg.solve(together, design)).sum(axis=0)
    return float(np.trace(np.linalg.inv(information)[:3, :3])) * noise**2


def covers(found: CenterEstimate) -> bool:
    """Return whether the predicted 95 % ellipse in observed directions contains the origin."""
    d = len(found.center)
    across = np.linalg.svd(found.unseen)[2][len(found.unseen) :] if len(found.unseen) else np.eye(d)
    e, spread = across @ found.center, across @ found.covariance @ across.T
    size = CHI2_95[len(e)] if found.within95 is None else found.within95
    return bool(e @ np.linalg.solve(spread, e) < size)
