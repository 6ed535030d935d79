"""Inputs of a calibration: recorded trials on one clock, and the settings.

All time stamps are nanoseconds of the host clock CLOCK_MONOTONIC, converted from device time by
``timing.clock``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.marker_refinement import RefinementSettings
    from jointfit_daemon.kinematics.chains import ChainModel
    from jointfit_daemon.limb_model import Method, Procedure

CenterMethod = Literal["sphere", "score", "sara", "geometric", "oriented", "grid", "three_frames"]
"""Names of the estimators of joint centers in rig.toml. ``sphere`` is the fit for skin markers in
`calibration.anatomy`. The others are keys of ``center_of_rotation.METHODS``.
"""
ONE_AXIS: frozenset[CenterMethod] = frozenset(
    ("sara", "geometric", "oriented", "grid", "three_frames")
)
"""Estimators that need a movement about one axis."""


@dataclass(frozen=True, slots=True)
class SensorTrack:
    """Orientations of one sensor over time."""

    t_ns: NDArray[np.int64]
    """Time stamps, ns, shape (n,), strictly increasing."""
    q_world_sensor: NDArray[np.float64]
    """Orientations in the sensor's own world, shape (n, 4)."""


@dataclass(frozen=True, slots=True)
class OpticalTrack:
    """Measurements of the optical system over time, with NaN for occluded markers and bodies."""

    t_ns: NDArray[np.int64]
    """Instants of exposure of the m frames, ns, shape (m,), strictly increasing."""
    markers: tuple[str, ...]
    positions: NDArray[np.float64]
    """Marker positions in the optical world (z up), m, shape (m, len(markers), 3)."""
    bodies: tuple[str, ...]
    body_positions: NDArray[np.float64]
    """Positions of the rigid bodies in the optical world, m, shape (m, len(bodies), 3)."""
    body_orientations: NDArray[np.float64]
    """Orientations q_world_body of the rigid bodies, shape (m, len(bodies), 4)."""
    residuals: NDArray[np.float64] | None = None
    """Residuals of the cameras for the markers, m, shape (m, len(markers)); NaN where unknown. None
    if no frame has residuals."""


@dataclass(frozen=True, slots=True)
class CalibrationTrial:
    """Recording of one phase of a calibration."""

    sensors: Mapping[str, SensorTrack]
    optical: OpticalTrack | None


@dataclass(frozen=True, slots=True)
class ChainRefinement:
    """Settings for the refinement of the markers of a chain model in the functional phase."""

    model: ChainModel
    """Chain model that rig.toml names, with the locks and weights of the refinement."""
    settings: RefinementSettings
    limit_s: float
    """Longest duration of the iteration, s."""


@dataclass(frozen=True, slots=True)
class CalibrationSettings:
    """Settings of the calibration in rig.toml, in SI units.

    The keys in rig.toml are the fields of `config._tables.CalibrationTable`.
    """

    method: Method = "anchored"
    procedure: Procedure = "corrected"
    """Procedure of the calibration. ``patent`` uses the mean of the quaternion components in the
    static pose, markers without refinement, and the regression that was verified on the held-out
    part of the trial.
    """
    static_s: float = 5.0
    align_s: float = 30.0
    functional_s: float = 60.0
    """Longest duration of the functional phase, s."""
    functional_min_s: float = 45.0
    """Shortest duration of the functional phase, s. The regression needs this much movement, even
    if the joint centers converge earlier.
    """
    center_target_m: float = 0.003
    """Random error of the joint centers, m, below which the movement is sufficient.

    The random error is the part of the predicted error that decreases with more movement."""
    center_method: CenterMethod = "sphere"
    """Estimator of the joint centers."""
    joint_center_methods: Mapping[str, CenterMethod] = field(default_factory=dict)
    """Estimator by joint, for joints that do not use `center_method`."""
    markers: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Marker names, by segment or adjacent body part (pelvis, foot)."""
    rigid_bodies: Mapping[str, str] = field(default_factory=dict)
    """Rigid body of the mocap software by segment, for segments without individual markers."""
    plate: str | None = None
    """Rigid body of the calibration plate that carries the sensors in the align phase."""
    holdout_share: float = 0.4
    """Fraction of the functional trial, at its end, that is held out for evaluation."""
    refine_markers: bool = True
    """Whether marker positions on the body parts are refined from the movement."""
    chain_refinement: ChainRefinement | None = None
    """Refinement of the chain model; None if it is not refined."""
    learn_online: bool = True
    """Whether the models are refitted while the limb is visible to the cameras."""

    def center_method_of(self, joint: str) -> CenterMethod:
        """Return the estimator of one joint center."""
        return self.joint_center_methods.get(joint, self.center_method)


PLATE = "plate"
"""Key of `markers` in rig.toml for a calibration plate that is a set of markers."""


@dataclass(frozen=True, slots=True)
class OnlineFrames:
    """New complete frames of sensors and markers, in order of time."""

    sensors: Mapping[str, Array]
    """q_optical_segment of each sensor, which includes the sensor-to-segment alignment, shape
    (n, 4) for n frames.
    """
    markers: Mapping[str, Array]
    """Positions of the k markers of each segment in the optical world, m, shape (n, k, 3).

    A segment with a rigid body is in `bodies` instead."""
    bodies: Mapping[str, Array]
    """q_world_body of each segment with a rigid body, shape (n, 4)."""
