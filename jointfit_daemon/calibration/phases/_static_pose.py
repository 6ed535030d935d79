"""Static calibration from sensors and markers in the static pose (N-pose).

A pose is accepted or rejected as a whole, and a rejection contains all reasons and remedies.
Without cameras the pose defines its own world, in which all segments are upright and face +y.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration._errors import CalibrationError
from jointfit_daemon.calibration._quality import StaticQuality, quality_table, sensor_rotations
from jointfit_daemon.calibration.anatomy import CONFIGURED_SD_M, marked_parts, static_cluster
from jointfit_daemon.calibration.record import trials_digest
from jointfit_daemon.calibration.registration import (
    RobustMean,
    StaticLimits,
    component_mean,
    robust_mean,
    static_problems,
)
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.limb_model import (
    UNREFERENCED_SD,
    Calibration,
    JointCalibration,
    LabelFault,
    LabelSearch,
    MeanModel,
    SegmentCalibration,
    SensorCalibration,
    chain_fields,
    configured_length,
    equal_weights,
    model_key,
    restore_cluster,
    rigid_fit,
)
from jointfit_daemon.model import FrameFlag

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from jointfit_daemon.calibration._trial import CalibrationSettings, CalibrationTrial
    from jointfit_daemon.calibration.phases._plate_alignment import PlateAlignment
    from jointfit_daemon.limb_model import MarkerCluster, StoredCluster
    from jointfit_daemon.model import Chain, Quaternion

MAX_TEMPLATE_RMS_M = 0.02
"""RMS residual of a cluster relative to the earlier pose above which its markers count as moved, m.
"""


@dataclass(frozen=True, slots=True)
class StaticPose:
    """Mean orientations over one static pose."""

    sensors: Mapping[str, RobustMean]
    """Mean q_world_sensor of each sensor, in the world of the sensor."""
    still_s: float
    clusters: Mapping[str, MarkerCluster] = field(default_factory=dict)
    """Body parts that are visible to cameras; empty without cameras."""
    digest: str = ""

    @property
    def quality(self) -> StaticQuality:
        """Duration, scatter of every sensor, and visible body parts."""
        spread_rad = {name: mean.spread for name, mean in self.sensors.items()}
        return StaticQuality(self.still_s, spread_rad, tuple(sorted(self.clusters)))


def fit_static(trial: CalibrationTrial, settings: CalibrationSettings, chain: Chain) -> StaticPose:
    """Return the static pose of a trial.

    Raises
    ------
    CalibrationError
        A sensor has no data or scatters too much, the pose is too short, or markers are unknown,
        hidden or on a line. The error contains all reasons.
    """
    wanted = [sensor for group in chain.sensors for sensor in group]
    present = [s for s in wanted if s in trial.sensors and len(trial.sensors[s].t_ns) >= 2]
    reasons = [
        f"{sensor}: no data in the static pose; switch it on, or remove it from rig.toml"
        for sensor in wanted
        if sensor not in present
    ]

    average = component_mean if settings.procedure == "patent" else robust_mean
    means = {s: average(trial.sensors[s].q_world_sensor) for s in present}
    stamps = [trial.sensors[s].t_ns for s in present]
    still_s = min((float(t_ns[-1] - t_ns[0]) / 1e9 for t_ns in stamps), default=0.0)

    # rig.toml may configure a pose shorter than three seconds. 90 % of the duration is accepted,
    # because the samples do not span the whole pose.
    limits = StaticLimits(still_s=0.9 * min(StaticLimits().still_s, settings.static_s))

    if present:
        reasons += static_problems(means, still_s, limits)

    clusters: dict[str, MarkerCluster] = {}
    if trial.optical is not None and len(trial.optical.t_ns) > 0:
        for name in marked_parts(settings, chain):
            try:
                clusters[name] = static_cluster(trial.optical, name, settings)
            except CalibrationError as refusal:
                reasons += refusal.reasons

    if reasons:
        raise CalibrationError(*reasons)
    return StaticPose(means, still_s, clusters, trials_digest(trial))


def sensor_calibration(
    mean: RobustMean, q_optical_world: Quaternion, q_static: Quaternion, lag_ns: int = 0
) -> SensorCalibration:
    """Return the calibration of one sensor from its mean orientation in the static pose.

    The sensor-to-segment alignment is (q_optical_world q_world_sensor)* q_optical_segment.
    """
    q_optical_sensor = rotation.multiply(q_optical_world, mean.q)
    bias = rotation.multiply(rotation.conjugate(q_optical_sensor), q_static)
    return SensorCalibration(q_optical_world, as_quaternion(bias), lag_ns, mean.spread)


def fit_static_only(
    pose: StaticPose, alignment: PlateAlignment | None, chain: Chain, *, software: str = ""
) -> Calibration:
    """Calibrate without cameras, with all segments upright and the plain mean of the sensors.

    Without an alignment, every sensor world is assumed to equal the world of the static pose, as in
    the patent. If the headings of the sensors are arbitrary, only the inclination is then correct.
    The flag is ``headings_from_static`` without an alignment, ``facing_unknown`` with an alignment.
    """
    upright: Quaternion = (1.0, 0.0, 0.0, 0.0)
    flag = FrameFlag.FACING_UNKNOWN
    worlds = dict.fromkeys(pose.sensors, upright)
    if alignment is None:
        flag = FrameFlag.HEADINGS_FROM_STATIC
    else:
        worlds = {name: alignment.world(name) for name in pose.sensors}

    # The models are the equal-weight mean of all sensors of a segment, and each sensor alone.
    models = [
        {
            model_key(alive, None): MeanModel(equal_weights(len(alive)), UNREFERENCED_SD)
            for alive in sorted({group, *((sensor,) for sensor in group)})
        }
        for group in chain.sensors
    ]
    lengths = [configured_length(chain, i) for i in range(len(chain.segments))]
    sensors = {
        name: sensor_calibration(mean, worlds[name], upright) for name, mean in pose.sensors.items()
    }
    return Calibration(
        method="mean",
        **chain_fields(chain),
        sensor=sensors,
        segment={
            name: SegmentCalibration(
                upright, length, None if length is None else CONFIGURED_SD_M, own
            )
            for name, length, own in zip(chain.segments, lengths, models, strict=True)
        },
        joint={name: JointCalibration(None, None, "unknown") for name in chain.joints},
        flags=(flag,),
        notes=("no cameras: angles are relative to the static pose; standard deviation assumed",),
        quality={
            "static": quality_table(pose.quality),
            "sensors": quality_table(sensor_rotations(sensors)),
            "functional": None,
        },
        digest=pose.digest,
        software=software,
    )


def with_new_static(
    calibration: Calibration, pose: StaticPose, alignment: PlateAlignment | None = None
) -> Calibration:
    """Return the calibration with new sensor-to-segment alignments, after re-donning.

    If the markers of a segment are visible and at their earlier positions on the body, they
    determine the current orientation of the segment. Otherwise, and in the procedure of the patent,
    the segment is assumed to have the orientation and heading of the earlier pose. After such an
    assumption, a calibration with marker clusters has the flag ``same_pose_assumed``.

    Parameters
    ----------
    alignment : PlateAlignment, optional
        Plate alignment that is newer than the calibration. Its worlds and estimated lags are used.

    Raises
    ------
    CalibrationError
        The pose or the alignment lacks a calibrated sensor, or markers were moved.
    """
    if missing := [name for name in calibration.sensor if name not in pose.sensors]:
        raise CalibrationError(
            *(f"{name}: no data in the new static pose; switch it on" for name in missing)
        )

    if exchanges := _label_exchanges(calibration, pose):
        raise CalibrationError(
            *(f"{one.text}; correct the labels and repeat the phase" for one in exchanges)
        )

    # Current orientation of every segment, from cameras or from the earlier pose.
    q_now: dict[str, Quaternion] = {}
    assumed = False
    for name, segment in calibration.segment.items():
        turned = None
        if calibration.procedure == "corrected":
            turned = _part_rotation(calibration.clusters.get(name), pose.clusters.get(name))
        assumed |= turned is None and bool(calibration.clusters)
        q = segment.q_static if turned is None else rotation.multiply(turned, segment.q_static)
        q_now[name] = as_quaternion(q)

    # The mounts are computed from the new means. A newer alignment supplies worlds and lags.
    owner = {
        sensor: segment
        for segment, group in zip(calibration.segments, calibration.chain_sensors, strict=True)
        for sensor in group
    }
    sensors = {}
    for name, old in calibration.sensor.items():
        world, lag_ns = old.q_optical_world, old.lag_ns
        if alignment is not None:
            world, found_ns = alignment.world(name), alignment.quality[name].lag_ns
            lag_ns = lag_ns if found_ns is None else found_ns
        sensors[name] = sensor_calibration(pose.sensors[name], world, q_now[owner[name]], lag_ns)

    same_pose = FrameFlag.SAME_POSE_ASSUMED
    flags = [flag for flag in calibration.flags if flag != same_pose]
    flags += [same_pose] if assumed else []
    quality = {**calibration.quality, "static": quality_table(pose.quality)}
    quality["sensors"] = quality_table(sensor_rotations(sensors))
    if alignment is not None:
        quality["alignment"] = quality_table(alignment.quality)
    return replace(calibration, sensor=sensors, flags=tuple(flags), quality=quality)


def _label_exchanges(calibration: Calibration, pose: StaticPose) -> list[LabelFault]:
    """Return exchanges of marker labels in body parts whose markers do not fit the calibration."""
    stored = calibration.clusters
    same = [
        name
        for name, one in pose.clusters.items()
        if name in stored and one.body is None and stored[name].markers == one.markers
    ]
    if not same:
        return []
    search = LabelSearch(restore_cluster(name, stored[name]) for name in same)
    points = [pose.clusters[name].template + pose.clusters[name].origin for name in same]
    rms, faults = search.explain(np.concatenate(points))
    wrong = {name for name, one in zip(same, rms.tolist(), strict=True) if one > MAX_TEMPLATE_RMS_M}
    return [fault for fault in faults if len(fault.markers) > 1 and wrong & set(fault.parts)]


def _part_rotation(
    old: StoredCluster | None, new: MarkerCluster | None
) -> NDArray[np.float64] | None:
    """Return the rotation of a body part since its earlier pose.

    The result is None if the part is not visible or has other markers than in the earlier pose.
    """
    if old is None or new is None or old.markers != new.markers or old.body != new.body:
        return None
    if old.body is not None:
        return rotation.multiply(new.q_body, rotation.conjugate(old.q_body))

    q, _, rms = rigid_fit(np.array(old.template), (new.template + new.origin)[None])
    if rms[0] > MAX_TEMPLATE_RMS_M:
        raise CalibrationError(
            f"markers of {new.name}: {1000 * rms[0]:.0f} mm RMS from their earlier places on the "
            "body; repeat the functional calibration"
        )
    turned: NDArray[np.float64] = q[0]
    return turned
