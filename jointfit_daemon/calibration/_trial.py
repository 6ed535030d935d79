"""What a calibration is fitted to: recorded tracks on one clock, and what was asked for.

Law: plain data. All instants are host CLOCK_MONOTONIC nanoseconds, already through the clocks.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import Method
if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray


if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class SensorTrack:
    """Orientations of one sensor over time."""

    t_ns: NDArray[np.int64]
    """Shape (n,), strictly increasing."""
    q_world_sensor: NDArray[np.float64]
    """Shape (n, 4), the sensor's own world."""


@dataclass(frozen=True, slots=True)
class OpticalTrack:
    """What the optical system saw; NaN where it did not."""

    t_ns: NDArray[np.int64]
    """Instants of exposure, shape (m,), strictly increasing."""
    markers: tuple[str, ...]
    positions: NDArray[np.float64]
    """Marker positions in the optical world (z up), m, shape (m, len(markers), 3)."""
    bodies: tuple[str, ...]
    body_positions: NDArray[np.float64]
    """m, shape (m, len(bodies), 3)."""
    body_orientations: NDArray[np.float64]
    """q_world_body, shape (m, len(bodies), 4)."""


@dataclass(frozen=True, slots=True)
class CalibrationTrial:
    """One phase of a calibration as it was recorded."""

    sensors: Mapping[str, SensorTrack]
    optical: OpticalTrack | None


@dataclass(frozen=True, slots=True)
class CalibrationSettings:
    """What rig.toml says about calibration, in SI."""

    method: Method = "anchored"
    static_s: float = 5.0
    align_s: float = 30.0
    functional_s: float = 60.0
    """The movement ends by then at the latest."""
    functional_min_s: float = 45.0
    """And not before, however good the joint centers are: the regression wants its share."""
    center_target_m: float = 0.003
    """Noise part of every joint center's predicted error at which the movement is enough, m."""
    markers: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Markers of each segment or neighbouring body part (pelvis, foot)."""
    rigid_bodies: Mapping[str, str] = field(default_factory=dict)
    """Rigid body of each segment, where markers are not given."""
    plate: str | None = None
    """Rigid body of the plate that carries the sensors in the align phase."""
    holdout_share: float = 0.4
    """Last share of the functional trial, contiguous, that judges the fit."""
    refine_markers: bool = True
    """Whether the movement refines where markers sit on their body parts."""
    learn_online: bool = True
    """Whether the models go on learning while cameras see the limb."""


PLATE = "plate"
"""Key of `markers` in rig.toml for a plate that is a set of markers."""


@dataclass(frozen=True, slots=True)
class Fresh:
    """New frames, all sensors and markers whole, in order of time."""

    sensors: Mapping[str, Array]
    """q_optical_segment as each sensor says it through its bias, shape (n, 4)."""
    markers: Mapping[str, Array]
    """Of each segment's cluster, optical world, m, shape (n, k, 3); absent for rigid bodies."""
    bodies: Mapping[str, Array]
    """q_world_body of each segment followed by a rigid body, shape (n, 4)."""
