"""Simulated optical measurement with marker noise, occlusion and rigid-body fits.

Coordinates are in the optical world (z up), in m. The server converts them to its own axes.

The *base world* is the world in which the movement of the subject is described, with z up.

Invariant: rigid bodies are fitted to the skin markers. Only the reference bones of a recording are
streamed without a fit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_simulators.body import Rotation, heading, to_wxyz

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_simulators.body import InstrumentedSubject, Observation
    from jointfit_simulators.settings import Knobs

_FIT = 3
"""Minimum number of visible markers of a tracked rigid body."""
_UP_TO_Y = Rotation.from_euler("x", 90, degrees=True)


class CameraFrames(NamedTuple):
    """Camera frames of one block. Occluded markers and untracked bodies are NaN."""

    markers: Array
    """Marker positions, m, shape (n, markers, 3)."""
    body_positions: Array
    """Positions of the rigid bodies, m, shape (n, bodies, 3)."""
    body_orientations: Array
    """Orientations q_world_body of the rigid bodies, shape (n, bodies, 4)."""


class Cameras:
    """Optical system that records one subject.

    Rigid bodies are defined as an operator defines them: from the markers in upright stance. Their
    axes are parallel to the axes of the optical world after its conversion to y up, and their pivot
    is the mean marker position.

    Parameters
    ----------
    knobs
        Settings with occlusion and marker noise.
    subject
        Subject with markers.
    rate_hz
        Frame rate of the cameras, Hz.
    """

    def __init__(self, knobs: Knobs, subject: InstrumentedSubject, *, rate_hz: float) -> None:
        turned = knobs.random("optical world").uniform(-1, 1)
        self.heading_rad = float(np.radians(knobs.optical_heading_deg) * turned)
        self.world = heading(self.heading_rad)
        """Rotation from the base world to the optical world."""

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

        # Transition probabilities of the Markov chain, from mean burst length and occluded share.
        self._reappear = min(1.0, 1 / max(knobs.occlusion_burst_s * rate_hz, 1.0))
        self._vanish = self._reappear * knobs.occlusion / max(1e-9, 1 - knobs.occlusion)
        self._hidden = self._random.random(len(self.markers)) < knobs.occlusion
        self.covered = False
        """Whether all markers are occluded."""
        self._absent: set[str] = set()
        self._labels = list(range(len(self.markers)))
        """For each label, the index of the marker to which the label is assigned."""

    def hide(self, marker: str) -> None:
        """Occlude one marker."""
        self._absent.add(marker)

    def show(self, marker: str) -> None:
        """End the occlusion of one marker."""
        self._absent.discard(marker)

    def exchange(self, one: str, other: str) -> None:
        """Exchange the labels of two markers."""
        i, j = self.markers.index(one), self.markers.index(other)
        self._labels[i], self._labels[j] = self._labels[j], self._labels[i]

    def capture(self, observation: Observation) -> CameraFrames:
        """Return the camera frames of one block."""
        n = len(observation.markers)
        markers: Array = observation.markers @ self.world.as_matrix().T
        markers = markers + self._random.standard_normal(markers.shape) * self._noise_m
        markers[self._occlusion(n)] = np.nan
        markers[:, [self.markers.index(name) for name in self._absent]] = np.nan
        markers = markers[:, self._labels]

        bodies = [
            _fit(self._templates[part], markers[:, columns])
            for part, columns in self._columns.items()
        ]
        for bone in self._bones:
            turn, origin = observation.bones[bone]
            position, orientation = self.world.apply(origin), to_wxyz(self.world * turn)
            if self.covered:
                position, orientation = position * np.nan, orientation * np.nan
            bodies.append((position, orientation))
        if not bodies:
            return CameraFrames(markers, np.empty((n, 0, 3)), np.empty((n, 0, 4)))
        positions, orientations = zip(*bodies, strict=True)
        return CameraFrames(markers, np.stack(positions, axis=1), np.stack(orientations, axis=1))

    def _occlusion(self, n: int) -> NDArray[np.bool_]:
        """Return whether each marker is occluded, shape (n, markers).

        The occlusion is a two-state Markov chain.
        """
        draws = self._random.random((n, len(self.markers)))
        hidden = np.empty((n, len(self.markers)), dtype=np.bool_)
        now = self._hidden
        for row, draw in zip(hidden, draws, strict=True):
            now = np.where(now, draw >= self._reappear, draw < self._vanish)
            row[:] = now
        self._hidden = now
        return hidden | self.covered


def _fit(template: Array, markers: Array) -> tuple[Array, Array]:
    """Return position (n, 3) and orientation (n, 4) of a body from its markers (n, k, 3).

    The rotation is fitted to the visible markers (Kabsch). With fewer than three markers, position
    and orientation are NaN.
    """
    visible = np.isfinite(markers[:, :, 0])
    weight = (visible / np.maximum(visible.sum(axis=1, keepdims=True), 1))[:, :, None]

    measured = np.where(visible[:, :, None], markers, 0.0)
    body_mean = np.sum(weight * template, axis=1)
    mean = np.sum(weight * measured, axis=1)
    centered = (template - body_mean[:, None]) * weight

    u, _, vt = np.linalg.svd(np.swapaxes(measured - mean[:, None], 1, 2) @ centered)
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    turn = u @ vt

    position = mean - np.einsum("nij,nj->ni", turn, body_mean)
    orientation = to_wxyz(Rotation.from_matrix(turn)) if len(turn) else np.empty((0, 4))
    lost = visible.sum(axis=1) < _FIT
    position[lost] = np.nan
    orientation[lost] = np.nan
    return position, orientation
