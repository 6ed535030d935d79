"""Quality figures of a calibration, which are stored and published as JSON tables.

The names of the fields are the keys of the tables. Names of quantities end in their SI unit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jointfit_daemon.limb_model import SensorCalibration
    from jointfit_daemon.model import Quaternion, Vector


@dataclass(frozen=True, slots=True)
class StaticQuality:
    """Quality of the static pose."""

    still_s: float
    spread_rad: Mapping[str, float]
    """Robust scatter of the orientation of each sensor, rad."""
    body_parts: tuple[str, ...]
    """Body parts that are visible to cameras."""


@dataclass(frozen=True, slots=True)
class SensorRotations:
    """Rotations by which the fusion converts the orientation of one sensor to its segment."""

    q_sensor_segment: Quaternion
    """Sensor-to-segment alignment."""
    q_optical_world: Quaternion


@dataclass(frozen=True, slots=True)
class WorldQuality:
    """Alignment of the world of one sensor with the optical world."""

    kind: str
    """Kind of the alignment: ``full``, ``heading`` (the verticals of both worlds are assumed to be
    correct) or ``stored`` (copied from the current calibration).
    """
    kappa: float
    """Ratio of two singular values, 0 to 1 (`SensorAlignment.kappa`). At 1, the rotation of the
    world and the sensor-to-segment alignment cannot be distinguished.
    """
    error_rad: float
    """Standard error of the alignment in its least observable direction."""
    rms_rad: float
    """RMS angle between the measured and the modeled orientation of the plate."""
    lag_ns: int | None
    """Sensor time stamp minus optical time stamp of the same event; None if not observable."""
    lag_sigma_ns: float | None
    """Standard deviation of the lag; None if unknown."""


@dataclass(frozen=True, slots=True)
class MeasuredLag:
    """Lag of one sensor, estimated from the functional movement alone."""

    lag_ns: int
    sigma_ns: int
    r2: float


@dataclass(frozen=True, slots=True)
class LagQuality:
    """The lag that is used for one sensor, and the lag from the functional movement alone."""

    source: str
    """Source of the lag that is used; `SensorLag` lists the values."""
    lag_ns: int | None = None
    sigma_ns: int | None = None
    refused: str | None = None
    """Reason why no lag could be estimated from the movement."""
    movement: MeasuredLag | None = None


@dataclass(frozen=True, slots=True)
class PartQuality:
    """RMS marker residual of one body part on held-out frames before and after refinement."""

    before_m: float
    after_m: float
    refined: bool
    """Whether the refined markers are used."""


@dataclass(frozen=True, slots=True)
class MarkerQuality:
    """Quality of the marker refinement."""

    parts: Mapping[str, PartQuality]
    moved_m: Mapping[str, float]
    """Displacement of each refined marker by the refinement, m."""


@dataclass(frozen=True, slots=True)
class MarkerErrors:
    """Errors of the markers of a chain model in inverse kinematics."""

    rms_m: float
    maximum_m: float
    """Largest error of one marker in one frame."""
    accepted: bool
    """Whether both errors are below the limits of `kinematics.accepted_errors`."""


@dataclass(frozen=True, slots=True)
class ChainQuality:
    """Quality of the refinement of a chain model. Errors are measured on held-out frames."""

    model: str
    method: str
    refused: str | None = None
    """Reason why no marker was refined; the fields below are then None."""
    frames: int | None = None
    """Number of frames from which the markers were refined."""
    judged: int | None = None
    """Number of held-out frames."""
    before: MarkerErrors | None = None
    after: MarkerErrors | None = None
    """Marker errors of the model that is used after the refinement."""
    parts: Mapping[str, PartQuality] | None = None
    """Result by segment, for segments of the model with refined markers."""
    moved_m: Mapping[str, float] | None = None
    """Displacement of each refined marker relative to its segment."""
    stopped: str | None = None
    """Reason why the iteration ended."""


@dataclass(frozen=True, slots=True)
class JointQuality:
    """Quality of one joint center."""

    source: str
    sd_m: float | None
    residual_rms_m: float | None
    gap_rms_m: float | None
    arc_rad: float | None
    unseen_directions: int


@dataclass(frozen=True, slots=True)
class CenterCoordinates:
    """One center of rotation in coordinates of one body part.

    The origin is the mean of the part's markers in the static pose. The axes are the segment axes.
    A part without IMU has the axes of the optical world in the static pose.
    """

    center_m: Vector
    covariance_m2: tuple[Vector, Vector, Vector]
    """Covariance of random error and soft-tissue artefact; 0 along the directions in `unseen`."""
    unseen: tuple[Vector, ...]
    """Unit directions along which the movement did not determine the center."""
    axis: Vector | None = None
    """Unit axis of a hinge."""


@dataclass(frozen=True, slots=True)
class CenterQuality:
    """Center of rotation of one joint from the movement alone.

    The prior that the subject stood upright in the static pose is not applied.
    """

    method: str
    frames: int
    effective_frames: float
    """Number of independent frames."""
    predicted_error_m: float
    """Square root of the mean variance over the observed directions, including soft-tissue
    artefact.
    """
    noise_error_m: float
    """Part of the predicted error that decreases with more movement."""
    bound_m: float | None
    """Cramér-Rao bound of the RMS error; None if a direction is unobserved."""
    residual_rms_m: float
    arc_rad: float
    conditioning: float
    flags: tuple[str, ...]
    segments: Mapping[str, CenterCoordinates]
    """Coordinates in each of the two body parts of the joint."""
    axis_sd_rad: float | None = None
    """Standard deviation of the axis in each direction perpendicular to it."""


@dataclass(frozen=True, slots=True)
class AxisQuality:
    """Quality of one flexion axis."""

    rms_rad: float
    off_plane_rad: float


@dataclass(frozen=True, slots=True)
class AnatomyQuality:
    """Quality of joint centers, segment lengths and flexion axes."""

    joints: Mapping[str, JointQuality]
    lengths_m: Mapping[str, float | None]
    length_sd_m: Mapping[str, float | None]
    length_sources: Mapping[str, str]
    flexion_axes: Mapping[str, AxisQuality]
    centers: Mapping[str, CenterQuality]
    """Centers of rotation of the joints with markers on both sides."""


@dataclass(frozen=True, slots=True)
class MethodErrors:
    """RMS error of every method, rad; None if the error is not finite."""

    anchored: float | None
    patent12: float | None
    patent6: float | None
    markley: float | None
    mean: float | None
    single: float | None
    sensors: Mapping[str, float | None]
    """Error of each sensor alone (orientation), or of one sensor of each segment (flexion), rad."""


@dataclass(frozen=True, slots=True)
class HoldoutQuality:
    """Errors on the last part of the trial, after a fit to the first part."""

    method: str
    share: float
    frames: int
    segments: Mapping[str, MethodErrors]
    """Errors of the orientation of each segment."""
    flexion: Mapping[str, MethodErrors]
    """Errors of the flexion of each inner joint."""
    procedure: str = "corrected"
    """Procedure of the calibration: ``corrected`` or ``patent``."""
    meaning: str = (
        "RMS distance from the optical reference on the last part of the trial, after a fit to the"
        " first part; the stored models were then fitted to the whole trial"
    )
    """Explanation for readers of the published table."""


@dataclass(frozen=True, slots=True)
class RegressionQuality:
    """Regression coefficients of one segment.

    The rows are w, x, y and z. The columns are `sensors` and, last, the intercept.
    """

    sensors: tuple[str, ...]
    q_sign: Quaternion
    """Reference quaternion. Before the regression, every quaternion whose dot product with the
    reference quaternion is negative changes its sign.
    """
    verified: tuple[tuple[float, ...], ...]
    """Coefficients that were fitted to the first part of the trial. ``holdout`` contains their
    errors.
    """
    stored: tuple[tuple[float, ...], ...]
    """Coefficients that the fusion uses. They were fitted to the whole trial or, in the procedure
    ``patent``, to its first part.
    """


@dataclass(frozen=True, slots=True)
class OnlineQuality:
    """RMS errors of the orientation of every segment and the flexion of every inner joint."""

    frames: int
    judged: int
    """Number of held-out frames."""
    before_rad: Mapping[str, float]
    """Errors of the current models on the held-out frames."""
    after_rad: Mapping[str, float]
    """Errors of the refitted models on the held-out frames."""
    known_before_rad: Mapping[str, float]
    """Errors of the current models on the training frames of the calibration."""
    known_after_rad: Mapping[str, float]
    """Errors of the refitted models on the training frames of the calibration."""
    rounds: int | None = None
    """Number of accepted refits since the functional calibration."""
    software: str | None = None
    taught: str | None = None
    """Digest of the trials of the functional calibration."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationQuality:
    """All figures of a functional calibration."""

    static: StaticQuality
    sensors: Mapping[str, SensorRotations]
    alignment: Mapping[str, WorldQuality] | None
    lag: Mapping[str, LagQuality]
    markers: MarkerQuality | None = None
    anatomy: AnatomyQuality
    holdout: HoldoutQuality
    regression: Mapping[str, RegressionQuality] | None = None
    """Coefficients of every segment; None if the method is not a regression."""


def sensor_rotations(sensors: Mapping[str, SensorCalibration]) -> dict[str, SensorRotations]:
    """Return the rotations of every sensor."""
    return {
        name: SensorRotations(item.q_sensor_segment, item.q_optical_world)
        for name, item in sensors.items()
    }


def quality_table(value: Any) -> Any:
    """Return the JSON form of figures; an optional field is omitted if it is None."""
    if is_dataclass(value):
        found = ((field, getattr(value, field.name)) for field in fields(value))
        return {
            field.name: quality_table(figure)
            for field, figure in found
            if figure is not None or field.default is MISSING
        }
    if isinstance(value, Mapping):
        return {key: quality_table(figure) for key, figure in value.items()}
    return [quality_table(item) for item in value] if isinstance(value, tuple) else value
