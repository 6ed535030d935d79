"""Two simulated bodies with a ball joint, observed by noisy markers on soft tissue.

Invariant: the joint is at the origin of the parent frame. All random numbers are from the given
generator.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation import BodyPoses, Movement
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import rigid_fit

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

FRAMES = 300
WIDTH_M = 0.08
AWAY_M = 0.2


@dataclass(frozen=True, slots=True)
class Subject:
    """Marker positions and movement of one subject."""

    parent: Array
    """Marker positions of the parent relative to the joint, m, shape (k, 3)."""
    child: Array
    """Marker positions of the child without rotation, m, shape (k, 3)."""
    phase: Array
    """Phases of the rotation about the three axes, rad, shape (3,)."""

    @classmethod
    def random(cls, rng: np.random.Generator, markers: int) -> Subject:
        """Return a subject with clusters of width `WIDTH_M` at `AWAY_M` from the joint."""
        above, below = (_cluster(rng, markers, sign * AWAY_M) for sign in (1.0, -1.0))
        return cls(above, below, rng.uniform(0.0, 2.0 * np.pi, 3))

    def turns(self, rom_deg: float) -> Array:
        """Return a smooth movement in all directions as rotation vectors, rad, (n, 3)."""
        s = np.linspace(0.0, 2.0 * np.pi, FRAMES)[:, None] * np.array([3.0, 4.0, 5.0])
        return np.asarray(np.radians(rom_deg) / 2.0 * np.sin(s + self.phase))

    def observe(
        self, rng: np.random.Generator, rom_deg: float, noise: float, soft_tissue: float = 0.0
    ) -> Movement:
        """Return one recording; parent and child move, and both poses are fitted to markers.

        Parameters
        ----------
        rng : Generator
        rom_deg : float
            Range of motion about each axis, deg.
        noise : float
            Standard deviation of every coordinate of every marker, m.
        soft_tissue : float
            RMS of each coordinate of the marker motion relative to the bone, m. The motion is a
            random polynomial of second degree in the posture.
        """
        v = self.turns(rom_deg)
        joint = rotation.to_matrix(rotation.exp(v))
        moved = rotation.to_matrix(rotation.exp(rng.normal(0.0, 0.1, v.shape)))
        t = rng.normal(0.0, 0.05, (len(v), 1, 3))

        def seen(turns: Array, markers: Array) -> Array:
            on_skin = np.broadcast_to(markers, (len(v), *markers.shape))
            if soft_tissue > 0.0:
                on_skin = on_skin + soft_tissue * _artefact(rng, v, len(markers))
            exact = np.einsum("nij,nkj->nki", turns, on_skin) + t
            return np.asarray(exact + rng.normal(0.0, noise, exact.shape))

        above, below = seen(moved, self.parent), seen(moved @ joint, self.child)
        parent = BodyPoses(*rigid_fit(self.parent, above)[:2])
        child = BodyPoses(*rigid_fit(self.child, below)[:2])
        return Movement(parent.to_body(below), parent, child, parent_markers=self.parent)


def _cluster(rng: np.random.Generator, count: int, along: float) -> Array:
    """Return markers on an irregular circle around a limb segment, m, shape (count, 3)."""
    turn = 2.0 * np.pi * (np.arange(count) + rng.uniform(-0.2, 0.2, count)) / count
    turn += rng.uniform(0.0, 2.0 * np.pi)
    tilt = rng.uniform(-0.3, 0.3, count)
    p = np.stack((np.cos(turn), tilt, np.sin(turn)), axis=1)
    p = WIDTH_M / 2.0 * (p - p.mean(axis=0))
    beside = rng.uniform(-0.05, 0.05, 2)
    return np.asarray(p + np.array([beside[0], beside[1], along]))


def _artefact(rng: np.random.Generator, v: Array, count: int) -> Array:
    """Return a motion that depends on posture, with RMS 1 and mean 0, shape (n, count, 3)."""
    terms = np.concatenate((v, v * v, v * np.roll(v, 1, axis=1)), axis=1)
    terms = (terms - terms.mean(axis=0)) / terms.std(axis=0)
    moved = np.einsum("tf,fkc->tkc", terms, rng.normal(size=(terms.shape[1], count, 3)))
    return np.asarray(moved / np.sqrt((moved**2).mean()))
