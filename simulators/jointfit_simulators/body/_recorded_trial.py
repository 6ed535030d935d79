"""Recorded trials with sensors, bones and markers, interpolated between samples.

The recording already contains soft-tissue artefacts and sensor alignment. The motion ``trial``
plays the recording once, and then keeps the last posture. The motion ``stand`` is the static pose.
This pose follows from the sensor biases if they are known, with every segment upright by
definition. Otherwise, it is the first recorded frame.

The file type follows from the suffix: ``.npz`` or ``.sto`` (quaternions) for sensors, ``.trc`` for
markers, ``.json`` for biases (``{"q_bias": {"S1": [w, x, y, z]}}``). Files are y up, as OpenSim
writes them, except NPZ files that specify another axis.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.axes import quaternions_to_z_up, to_z_up
from jointfit_daemon.files.mocap import MarkerTrajectories, read_trc
from jointfit_daemon.files.orientations import (
    OrientationTrial,
    read_orientations_npz,
    read_orientations_sto,
)
from jointfit_daemon.files.text import read_json

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from jointfit_daemon.arrays import Array

BONES = {"femur": "thigh", "tibia": "shank", "thigh": "thigh", "shank": "shank"}
"""Segment of the rig for each bone name of a recording, without the suffix for the side."""

OPENCAP_CLUSTERS = {
    "pelvis": ("r.ASIS", "L.ASIS", "r.PSIS", "L.PSIS"),
    "thigh": ("r_thigh1", "r_thigh2", "r_thigh3", "r_thigh4"),
    "shank": ("r_sh2", "r_sh3", "r_sh4", "r_shank_antsup"),
    "foot": ("r_calc", "r_5meta", "r_toe"),
}
"""Marker clusters of the right leg in OpenCap's laboratory recordings."""


@dataclass(frozen=True)
class RecordedTrial:
    """Recorded data of one trial, z up, with one time axis that begins at 0."""

    orientations: OrientationTrial
    markers: MarkerTrajectories | None = None
    biases: Mapping[str, Array] = field(default_factory=dict)
    """Orientation q_sensor_segment in the static pose, by sensor."""

    @property
    def seconds(self) -> float:
        """Duration of the trial, s."""
        return float(self.orientations.t_s[-1])


def read_recorded_trial(paths: Sequence[Path]) -> RecordedTrial:
    """Return the trial that several files contain.

    Raises
    ------
    ValueError
        The number of sensor files is not one, or the type of a file is unknown.
    """
    orientations: list[OrientationTrial] = []
    markers: MarkerTrajectories | None = None
    biases: dict[str, Array] = {}
    for path in paths:
        match path.suffix.lower():
            case ".npz":
                orientations.append(read_orientations_npz(path))
            case ".sto":
                table = read_orientations_sto(path)
                sensors = {
                    name: quaternions_to_z_up(table.quaternions[:, i])
                    for i, name in enumerate(table.names)
                }
                orientations.append(OrientationTrial(table.t_s, sensors, {}, {}))
            case ".trc":
                markers = read_trc(path)
            case ".json":
                q_bias = read_json(path)["q_bias"]
                biases = {name: quaternions_to_z_up(q) for name, q in q_bias.items()}
            case other:
                raise ValueError(
                    f"{path}: no trial is read from {other!r} files; expected .npz, .sto, .trc or"
                    " .json"
                )
    if len(orientations) != 1:
        raise ValueError(f"a trial needs one .npz or .sto with sensors, got {len(orientations)}")

    (trial,) = orientations
    return RecordedTrial(dataclasses.replace(trial, t_s=trial.t_s - trial.t_s[0]), markers, biases)


class InterpolatedTrack:
    """Vectors or quaternions over time, interpolated between their samples.

    The interpolation is linear. Unit quaternions are sign-aligned before it, and normalized after
    it. The result then differs by less than 1e-5 rad from a rotation at constant rate if successive
    samples differ by less than 5 degrees.

    Parameters
    ----------
    t_s
        Increasing times, s, shape (n,).
    values
        Values, shape (n, 3) or (n, 4). A NaN makes the two adjacent intervals unknown.
    rotation
        Whether the values are unit quaternions.
    """

    def __init__(self, t_s: Array, values: Array, *, rotation: bool) -> None:
        self._t_s, self._values, self._rotation = t_s, values, rotation
        if rotation:
            turned = np.sum(values[1:] * values[:-1], axis=1) < 0
            self._values = values * np.append(1.0, np.cumprod(np.where(turned, -1.0, 1.0)))[:, None]

    def at(self, t_s: Array) -> Array:
        """Return the values at times of shape (n,), which are limited to the recorded time."""
        right = np.clip(np.searchsorted(self._t_s, t_s, side="right"), 1, len(self._t_s) - 1)
        begin, end = self._t_s[right - 1], self._t_s[right]
        share = np.clip((t_s - begin) / (end - begin), 0.0, 1.0)[:, None]

        # Exactly at a sample, only this sample is used, so a NaN of the adjacent sample has no
        # effect.
        before, after = self._values[right - 1], self._values[right]
        values = np.where(share == 0, before, np.where(share == 1, after, 0.0))
        between = ((share > 0) & (share < 1))[:, 0]
        values[between] = ((1 - share) * before + share * after)[between]
        if self._rotation:
            values /= np.linalg.norm(values, axis=1, keepdims=True)
        return values


def interpolated_markers(markers: MarkerTrajectories) -> InterpolatedTrack:
    """Return all markers as one track, z up, with the shape (n, 3 * markers)."""
    flat = to_z_up(markers.positions).reshape(len(markers.t_s), -1)
    return InterpolatedTrack(markers.t_s - markers.t_s[0], flat, rotation=False)
