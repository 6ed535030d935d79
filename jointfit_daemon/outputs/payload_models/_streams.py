"""Models of the streams: pose, sensors, optical reference, joints."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

Number = float | None
Vector = list[Number] | None
"""Components, or null while unknown."""
Time = int
"""UNIX time, µs."""


class Table(BaseModel):
    """A table of a payload; the tests reject keys that its model does not define."""

    model_config = ConfigDict(extra="forbid", strict=False)


class Payload(Table):
    """Base of all payloads."""

    v: Literal[1] = Field(description="version of the payload")


class Angles(Table):
    """Anatomical angles of a joint; the keys depend on the angle convention of the joint."""

    flexion_deg: Number = None
    adduction_deg: Number = None
    rotation_deg: Number = None
    plane_deg: Number = None
    elevation_deg: Number = None
    bending_deg: Number = None


class AnglesAndRates(Angles):
    """Angles and their rates."""

    flexion_deg_s: Number = None
    adduction_deg_s: Number = None
    rotation_deg_s: Number = None
    plane_deg_s: Number = None
    elevation_deg_s: Number = None
    bending_deg_s: Number = None


class PatentAngles(Table):
    """Angles by the definition of the patent."""

    alpha_deg: Number
    beta_deg: Number
    gamma_deg: Number
    joint_deg: Number
    gimbal: bool | None


class PoseSegment(Table):
    """Orientation of one segment."""

    q: Vector = Field(description="segment to world, scalar first")
    sd_deg: Number
    used: list[str] = Field(description="sensors that contributed")


class PoseJoint(AnglesAndRates):
    """Position and angles of one joint."""

    p_m: Vector
    sd_m: Number
    inner_deg: Number = None
    sd_deg: Number = None
    patent: PatentAngles | None = None


class Pose(Payload):
    """``pose`` and ``pose/ui``."""

    seq: int = Field(description="number of the frame; increases by 1 with every frame")
    t_us: Time
    completed_us: Time
    mono_us: int
    age_ms: float
    mode: Literal["uncalibrated", "imu", "imu+mocap"]
    sync: Literal["settling", "locked"]
    flags: list[str]
    segments: dict[str, PoseSegment]
    joints: dict[str, PoseJoint]


class JointScalars(AnglesAndRates, Payload):
    """``joint/NAME``."""

    t_us: Time
    x_m: Number
    y_m: Number
    z_m: Number
    sd_m: Number
    inner_deg: Number = None
    sd_deg: Number = None
    patent_alpha_deg: Number = None
    patent_beta_deg: Number = None
    patent_gamma_deg: Number = None
    patent_joint_deg: Number = None
    patent_gimbal: bool | None = None


class OpticalPoseSegment(Table):
    """Orientation of one segment, measured by the cameras."""

    q: Vector
    residual_deg: Number
    residual_rms_deg: Number


class OpticalPoseJoint(Angles):
    """Position and angles of one joint, measured by the cameras."""

    p_m: Vector
    gap_m: Number
    residual_m: Number
    residual_rms_m: Number
    inner_deg: Number = None
    residual: Angles | None = None
    residual_rms: Angles | None = None


class OpticalPose(Payload):
    """``optical/pose``."""

    t_us: Time
    frame: int
    segments: dict[str, OpticalPoseSegment]
    joints: dict[str, OpticalPoseJoint]


class ChainCoordinate(Table):
    """One coordinate of a chain model: an angle or a translation."""

    value_deg: Number = None
    sd_deg: Number = None
    value_m: Number = None
    sd_m: Number = None


class ChainCovariance(Table):
    """Covariance of the coordinates with a value."""

    names: list[str]
    rows: list[list[float]] = Field(description="rows of the matrix, in degrees and metres")


class FitErrors(Table):
    """Marker errors of one fit."""

    rms_m: Number
    maximum_m: Number
    accepted: bool


class OpticalChain(Payload):
    """``optical/chain``."""

    t_us: Time
    frame: int
    model: str
    refined: bool = Field(
        description="whether the marker positions come from the current calibration"
    )
    coordinates: dict[str, ChainCoordinate]
    covariance: ChainCovariance | None = None
    error_m: dict[str, Number]
    fit: FitErrors | None
    recent: FitErrors | None
    flags: list[str]


class SensorsPoseSensor(Table):
    """Orientation of one sensor, and of its segment from this sensor alone."""

    q: Vector
    q_segment: Vector


class SensorsPoseJoint(Table):
    """Rotation between two segments."""

    q: Vector


class SensorsPose(Payload):
    """``sensors/pose``."""

    seq: int
    t_us: Time
    sensors: dict[str, SensorsPoseSensor]
    joints: dict[str, SensorsPoseJoint]


class OpticalCenter(Table):
    """Running centre of one joint."""

    segment: str
    center_m: Vector
    covariance_m2: list[list[float]] | None
    unseen: list[Vector]
    axis: Vector
    p_m: Vector
    arc_deg: Number
    effective_frames: Number
    shift_m: Vector
    p_value: Number
    moved: bool | None
    refused: str | None


class OpticalCenters(Payload):
    """``optical/centers``."""

    t_us: Time
    memory_s: float
    joints: dict[str, OpticalCenter]


class SticksPlane(Table):
    """Plane of a planar movement."""

    normal: Vector
    off_plane_m: Number
    refused: str | None


class SticksJoint(Table):
    """Position of one joint of a planar movement."""

    p_m: Vector
    error_m: Number
    arc_deg: Number
    refused: str | None


class SticksSegment(Table):
    """One segment of the stick figure."""

    ends_m: list[Vector]


class OpticalSticks(Payload):
    """``optical/sticks``."""

    t_us: Time
    frame: int
    plane: SticksPlane
    joints: dict[str, SticksJoint]
    sticks: dict[str, SticksSegment]
