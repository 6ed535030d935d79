"""Simulated optical measurement: marker noise, occlusion and rigid-body fits.

Coordinates are in the optical world, z up, m; the server converts to its own axes.

Invariant: rigid bodies are fitted to the skin markers. Only the reference bones of a recording are
passed through.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_simulators.body import Rotation, heading, to_wxyz

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_simulators.body import InstrumentedSubject, Observation
    from jointfit_simulators.settings import Knobs

_FIT = 3
"""Markers a body needs to be tracked."""
_UP_TO_Y = Rotation.from_euler("x", 90, degrees=True)


class CameraFrames(NamedTuple):
    """What was seen in one block; NaN where nothing was."""

    markers: NDArray[np.float64]
    """Shape (n, markers, 3)."""
    body_positions: NDArray[np.float64]
    """Shape (n, bodies, 3)."""
    body_orientations: NDArray[np.float64]
    """q_world_body, shape (n, bodies, 4)."""


class Cameras:
    """An optical system that watches one subject.

    Rigid bodies are made as an operator makes them: from the markers in upright stance, with the
    body's axes along those of the (y-up) optical world and its pivot in the middle.

    Parameters
    ----------
    knobs
        Occlusion and scatter.
    subject
        Whose markers these are.
    rate_hz
        Camera frames a second.
    """

    def __init__(self, knobs: Knobs, subject: InstrumentedSubject, *, rate_hz: float) -> None:
        turned = knobs.random("optical world").uniform(-1, 1)
        self.heading_rad = float(np.radians(knobs.optical_heading_deg) * turned)
        self.world = heading(self.heading_rad)
        """Base world to the optical world."""
        self.markers = tuple(name for names in subject.clusters.values() for name in names)
        self._templates = {
            part: (self.world.inv() * _UP_TO_Y).inv().apply(points - points.mean(axis=0))
            for part, points in subject.templates.items()
        }
        self._columns = {
            part: [self.markers.index(name) for name in subject.clusters[part]]
            for part in subject.templates
        }
        self._bones = subject.visible_bones
        self.bodies = tuple(part.capitalize() for part in (*self._templates, *self._bones))
        self._random = knobs.random("cameras")
        self._noise_m = knobs.marker_noise_mm / 1e3 / np.sqrt(3)
        self._reappear = min(1.0, 1 / max(knobs.occlusion_burst_s * rate_hz, 1.0))
        self._vanish = self._reappear * knobs.occlusion / max(1e-9, 1 - knobs.occlusion)
        self._hidden = self._random.random(len(self.markers)) < knobs.occlusion
        self.covered = False
        """Somebody stands in front of everything."""

    def see(self, observation: Observation) -> CameraFrames:
        """Return the camera frames of one block."""
        n = len(observation.markers)
        seen: NDArray[np.float64] = observation.markers @ self.world.as_matrix().T
        seen = seen + self._random.standard_normal(seen.shape) * self._noise_m
        seen[self._occluded(n)] = np.nan
        fitted = [
            _fit(self._templates[part], seen[:, columns]) for part, columns in self._columns.items()
        ]
        fitted += [self._bone(observation, bone) for bone in self._bones]
        if not fitted:
            return CameraFrames(seen, np.empty((n, 0, 3)), np.empty((n, 0, 4)))
        positions, orientations = zip(*fitted, strict=True)
        return CameraFrames(seen, np.stack(positions, axis=1), np.stack(orientations, axis=1))

    def _occluded(self, n: int) -> NDArray[np.bool_]:
        """Return which markers are hidden, shape (n, markers): a two-state Markov chain each."""
        dice = self._random.random((n, len(self.markers)))
        hidden = np.empty((n, len(self.markers)), dtype=np.bool_)
        now = self._hidden
        for row, throw in zip(hidden, dice, strict=True):
            now = np.where(now, throw >= self._reappear, throw < self._vanish)
            row[:] = now
        self._hidden = now
        return hidden | self.covered

    def _bone(
        self, observation: Observation, bone: str
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        turn, origin = observation.bones[bone]
        position, orientation = self.world.apply(origin), to_wxyz(self.world * turn)
        if self.covered:
            position, orientation = (
                np.full_like(position, np.nan),
                np.full_like(orientation, np.nan),
            )
        return position, orientation


def _fit(
    template: NDArray[np.float64], seen: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return position (n, 3) and orientation (n, 4) of a body from its markers (n, k, 3).

    Kabsch's rotation over the visible markers; NaN where fewer than three are.
    """
    visible = np.isfinite(seen[:, :, 0])
    weight = (visible / np.maximum(visible.sum(axis=1, keepdims=True), 1))[:, :, None]
    there = np.where(visible[:, :, None], seen, 0.0)
    body_middle = np.sum(weight * template, axis=1)
    middle = np.sum(weight * there, axis=1)
    drawn = (template - body_middle[:, None]) * weight
    u, _, vt = np.linalg.svd(np.swapaxes(there - middle[:, None], 1, 2) @ drawn)
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    turn = u @ vt
    position = middle - np.einsum("nij,nj->ni", turn, body_middle)
    orientation = to_wxyz(Rotation.from_matrix(turn)) if len(turn) else np.empty((0, 4))
    lost = visible.sum(axis=1) < _FIT
    position[lost] = np.nan
    orientation[lost] = np.nan
    return position, orientation
