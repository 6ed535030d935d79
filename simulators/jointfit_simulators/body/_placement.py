"""Positions of sensors and markers on the subject, in the frame of their body part, m."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_simulators.body._orientation import Rotation

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_simulators.body._limb import LegGeometry

PLATE_MARKERS: dict[str, tuple[str, ...]] = {"plate": ("R1", "R2", "R3", "R4", "R5")}
"""Markers of the rigid plate."""
CLUSTERS: dict[str, tuple[str, ...]] = {
    "pelvis": ("P1", "P2", "P3", "P4"),
    "thigh": ("T1", "T2", "T3", "T4"),
    "shank": ("C1", "C2", "C3", "C4"),
    "foot": ("F1", "F2", "F3", "F4"),
    **PLATE_MARKERS,
}
"""Markers of leg and plate, by body part. The prefix C means calf, because S is a sensor; R means
rigid plate."""

PLATE_TEMPLATE = np.array(
    [
        (0.16, 0.10, 0.03),
        (-0.15, 0.11, 0.05),
        (0.15, -0.12, 0.04),
        (-0.16, -0.10, 0.02),
        (0.03, 0.02, 0.09),
    ]
)
"""Asymmetric marker positions in the frame of the plate, m, shape (5, 3)."""
_PLACEMENT_M = 0.008
"""Standard deviation of the placement error of a marker on the skin, per coordinate, m."""


def random_misalignment(random: np.random.Generator, most_rad: float) -> Rotation:
    """Return a sensor alignment: a rotation by at most `most_rad` about a random axis."""
    axis = random.standard_normal(3)
    return Rotation.from_rotvec(axis / np.linalg.norm(axis) * random.uniform(0, most_rad))


def marker_templates(random: np.random.Generator, geometry: LegGeometry) -> dict[str, Array]:
    """Return marker positions in the frame of each part, m, shape (4, 3).

    The pelvis markers are on the anterior and posterior iliac spines. Thigh and shank have clusters
    of four on the lateral and anterior side, distributed along the bone. The foot markers are on
    heel, instep and toes.
    """
    thigh, shank = geometry.thigh_m, geometry.shank_m
    nominal = {
        "pelvis": [
            (0.12, 0.08, 0.0),
            (-0.12, 0.08, 0.0),
            (0.05, -0.10, 0.02),
            (-0.05, -0.10, 0.02),
        ],
        "thigh": [
            (0.075, 0.03, -0.28 * thigh),
            (0.02, 0.085, -0.42 * thigh),
            (0.07, -0.035, -0.62 * thigh),
            (0.045, 0.06, -0.80 * thigh),
        ],
        "shank": [
            (0.055, 0.03, -0.20 * shank),
            (0.0, 0.06, -0.38 * shank),
            (0.055, -0.035, -0.58 * shank),
            (0.03, 0.04, -0.82 * shank),
        ],
        "foot": [
            (0.0, -0.06, -0.045),
            (0.035, 0.05, -0.03),
            (-0.035, 0.06, -0.02),
            (0.0, 0.13, -0.05),
        ],
    }

    return place_markers(nominal, random)


def place_markers(
    nominal: Mapping[str, Sequence[tuple[float, float, float]]], random: np.random.Generator
) -> dict[str, Array]:
    """Return marker positions with an operator's placement errors, m, shape (markers, 3)."""
    return {
        part: np.array(points) + random.normal(0.0, _PLACEMENT_M, (len(points), 3))
        for part, points in nominal.items()
    }
