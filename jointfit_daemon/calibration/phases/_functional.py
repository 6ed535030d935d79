"""Functional phase, which computes a complete calibration from a static pose and a movement.

The optical reference consists of skin markers. All quality figures are distances from this
reference, not from bones. All reasons for a rejection are reported at once, with remedies.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration._errors import CalibrationError
from jointfit_daemon.calibration._quality import (
    CalibrationQuality,
    HoldoutQuality,
    quality_table,
    sensor_rotations,
)
from jointfit_daemon.calibration.anatomy import (
    Anatomy,
    CenterChoice,
    ClusterTrack,
    exchanged_labels,
    find_anatomy,
    foreign_markers,
    track_clusters,
)
from jointfit_daemon.calibration.phases._cluster_refinement import RefinedClusters, refine_clusters
from jointfit_daemon.calibration.phases._inertial_rotations import inertial_rotations
from jointfit_daemon.calibration.phases._quality_figures import (
    anatomy_quality,
    joint_record,
    lag_notes,
    lag_quality,
)
from jointfit_daemon.calibration.phases._static_pose import (
    StaticPose,
    fit_static,
    sensor_calibration,
)
from jointfit_daemon.calibration.phases._training_set import MIN_FRAMES, MISALIGNED, limb_training
from jointfit_daemon.calibration.record import trials_digest
from jointfit_daemon.calibration.registration import (
    BODY,
    NO_LAG,
    SensorLag,
    fit_sensor_alignment,
    segment_lags,
    sensor_at,
    sensor_lags,
    tracked_lags,
)
from jointfit_daemon.calibration.soft_tissue import (
    LimbTraining,
    evaluate_methods,
    fit_links,
    fit_models,
    fit_verified_models,
    joint_error_correlations,
    pack,
    regression_quality,
    thin_evenly,
)
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.limb_model import (
    MAX_FIT_RMS_M,
    Calibration,
    SegmentCalibration,
    SensorCalibration,
    chain_fields,
    cluster_record,
    visible,
)
from jointfit_daemon.model import FrameFlag

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration._trial import (
        CalibrationSettings,
        CalibrationTrial,
        OpticalTrack,
    )
    from jointfit_daemon.calibration.phases._plate_alignment import PlateAlignment
    from jointfit_daemon.limb_model import MarkerCluster, SegmentModel
    from jointfit_daemon.model import Chain, Quaternion
    from jointfit_daemon.timing.lag import LagEstimate

MIN_SEEN = 0.5
"""Smallest fraction of frames in which a body part must be visible."""
PLATE_SD_NS = 500_000.0
"""Assumed standard deviation of a lag from the align phase for which the phase stored none, ns."""
STORED_SD_NS = 3e6
"""Standard deviation of a lag from the current calibration, ns. Such a lag may contain an error
from soft-tissue artefact.
"""


def fit_calibration(
    static: StaticPose | CalibrationTrial,
    functional: CalibrationTrial,
    alignment: PlateAlignment | None,
    settings: CalibrationSettings,
    chain: Chain,
    *,
    previous: Calibration | None = None,
    software: str = "",
    lag_ns: Mapping[str, int] | None = None,
    tracked: Mapping[str, tuple[float, float]] | None = None,
) -> Calibration:
    """Calibrate a limb.

    Parameters
    ----------
    static : StaticPose or CalibrationTrial
        The static pose, or its trial.
    functional : CalibrationTrial
        The movement, with data of the optical system. Sensor time stamps are not corrected for lag.
    alignment : PlateAlignment or None
        Alignment of the sensor worlds. With None, all sensor worlds are assumed to equal the
        optical world, and the calibration has the flag ``headings_from_static``.
    settings : CalibrationSettings
        Methods, markers and held-out fraction from rig.toml.
    chain : Chain
        The limb.
    previous : Calibration, optional
        Calibration whose lags are used for sensors whose lag this movement does not determine.
    software : str
        Version of the program, which is stored in the calibration.
    lag_ns : mapping, optional
        Configured lags by sensor, ns. The lags of other sensors are estimated.
    tracked : mapping, optional
        Lags and standard deviations that were tracked at run time, by sensor, ns. A tracked lag
        replaces the lag from `previous` if the tracked lag has the smaller standard deviation.

    Raises
    ------
    CalibrationError
        The optical system, markers or sensors are missing, or there are too few visible frames or
        too little movement.
    """
    pose = static if isinstance(static, StaticPose) else fit_static(static, settings, chain)

    # The optical reference consists of body parts. The lags of the sensors are relative to this
    # reference.
    refined, tracks = refined_tracks(_tracks(pose, functional, chain), pose, functional, settings)
    moving = _lags(chain, functional, tracks, lag_ns or {})
    lags = _lags_in_use(chain, moving, alignment, _earlier_lags(previous, tracked), lag_ns or {})

    # Joint centers, segment axes, and sensor-to-segment alignments.
    raw = _sensors_at(next(iter(tracks.values())).t_ns, functional, pose, lags)
    anatomy = find_anatomy(chain, tracks, _center_choice(chain, raw, pose, alignment, settings))
    sensors = _sensors(chain, pose, alignment, anatomy, lags)

    # Segment models.
    training, notes = _training(chain, functional, tracks, anatomy, sensors, alignment=alignment)
    models, holdout = _models(chain, training, settings)
    quality = CalibrationQuality(
        static=pose.quality,
        sensors=sensor_rotations(sensors),
        alignment=None if alignment is None else alignment.quality,
        lag={name: lag_quality(moving.get(name), lags.get(name, NO_LAG)) for name in sensors},
        markers=refined.figures,
        anatomy=anatomy_quality(chain, anatomy, tracks),
        holdout=holdout,
        regression=regression_quality(chain, training, models, settings.holdout_share),
    )
    return Calibration(
        method=settings.method,
        **chain_fields(chain),
        sensor=sensors,
        segment=_segments(anatomy, models),
        joint={name: joint_record(found) for name, found in anatomy.joints.items()},
        clusters={name: cluster_record(cluster) for name, cluster in refined.clusters.items()},
        flags=(*anatomy.flags, *([FrameFlag.HEADINGS_FROM_STATIC] if alignment is None else [])),
        notes=(*refined.notes, *anatomy.notes, *lag_notes(moving, lags), *notes),
        quality=quality_table(quality),
        digest=trials_digest(None if isinstance(static, StaticPose) else static, functional),
        software=software,
        links=fit_links(chain, training.sensors, anatomy.q_static),
        correlations=joint_error_correlations(chain, training, settings.method),
        memory=pack(chain, thin_evenly(chain, training)) if settings.method == "anchored" else "",
        procedure=settings.procedure,
    )


def _tracks(
    pose: StaticPose, functional: CalibrationTrial, chain: Chain
) -> dict[str, ClusterTrack]:
    """Return the poses of all body parts; raise an error if the reference is not usable."""
    if functional.optical is None or len(functional.optical.t_ns) < MIN_FRAMES:
        raise CalibrationError("functional: no data of the optical system; check that it streams")

    reasons = [
        f"{segment}: no markers in the static pose; name them under markers.{segment} "
        "and repeat the static pose in view of the cameras"
        for segment in chain.segments
        if segment not in pose.clusters
    ]

    tracks = track_clusters(functional.optical, pose.clusters)
    faults, explained = _label_faults(functional.optical, pose.clusters)
    reasons += faults
    for segment in chain.segments:
        if segment in explained:
            continue
        misfit = float((tracks[segment].rms > MAX_FIT_RMS_M).mean()) if segment in tracks else 0.0
        if misfit > MIN_SEEN:
            reasons.append(
                f"{segment}: in {100 * misfit:.0f} % of the trial its markers do not fit the "
                "static pose; check the marker names, and whether a marker was displaced, and "
                "repeat the pose"
            )
            continue
        share = float(visible(tracks[segment].q).mean()) if segment in tracks else 1.0
        if share < MIN_SEEN:
            reasons.append(
                f"{segment}: at least three markers were visible in {100 * share:.0f} % of "
                "the trial, 50 % are needed; add a marker or stay in view"
            )
    reasons += [
        f"{sensor}: no data in the movement; switch it on and repeat"
        for group in chain.sensors
        for sensor in group
        if sensor not in functional.sensors
    ]

    if reasons:
        raise CalibrationError(*reasons)
    return tracks


def _label_faults(
    track: OpticalTrack, clusters: Mapping[str, MarkerCluster]
) -> tuple[list[str], set[str]]:
    """Return the reasons to refuse a movement because of its labels, and their body parts."""
    # A marker whose label was exchanged after the static pose also moves with another part, so both
    # searches report it. If `foreign_markers` reports a further marker of a part, the cluster of
    # this part is wrong, and the exchanges that were found with this cluster are not reliable.
    foreign = foreign_markers(track, clusters)
    exchanges = [
        exchange
        for exchange in exchanged_labels(track, clusters)
        if all(one.marker in exchange.markers for one in foreign if one.part in exchange.parts)
    ]
    explained = {part for exchange in exchanges for part in exchange.parts}
    foreign = [one for one in foreign if one.part not in explained]
    reasons = [f"{one.text}; correct the labels and repeat the phase" for one in exchanges]
    return reasons + [one.text for one in foreign], explained | {one.part for one in foreign}


def refined_tracks(
    tracks: dict[str, ClusterTrack],
    pose: StaticPose,
    functional: CalibrationTrial,
    settings: CalibrationSettings,
) -> tuple[RefinedClusters, dict[str, ClusterTrack]]:
    """Refine the markers, if configured, and return the poses of the refined body parts.

    In the procedure of the patent the measured markers are the reference, without refinement.
    """
    refine = settings.refine_markers and settings.procedure == "corrected"
    if not refine or functional.optical is None:
        return RefinedClusters(pose.clusters, None), tracks
    refined = refine_clusters(pose.clusters, tracks, settings.holdout_share)
    if refined.figures is None:
        return refined, tracks
    return refined, track_clusters(functional.optical, refined.clusters)


def _lags(
    chain: Chain,
    functional: CalibrationTrial,
    tracks: Mapping[str, ClusterTrack],
    known: Mapping[str, int],
) -> dict[str, LagEstimate]:
    out: dict[str, LagEstimate] = {}
    for segment, group in zip(chain.segments, chain.sensors, strict=True):
        track = tracks[segment]
        unknown = {s: functional.sensors[s] for s in group if s not in known}
        out |= sensor_lags(track.t_ns, track.q, unknown, BODY)
    return out


def _sensors_at(
    t_ns: NDArray[np.int64],
    functional: CalibrationTrial,
    pose: StaticPose,
    lags: Mapping[str, SensorLag],
) -> dict[str, Array]:
    """Return the orientation of every sensor at instants of the optical system."""
    return {
        name: sensor_at(functional.sensors[name], t_ns, lags.get(name, NO_LAG).lag_ns)
        for name in pose.sensors
    }


def _center_choice(
    chain: Chain,
    raw: Mapping[str, Array],
    pose: StaticPose,
    alignment: PlateAlignment | None,
    settings: CalibrationSettings,
) -> CenterChoice:
    methods = {joint: settings.center_method_of(joint) for joint in chain.joints}
    needs_imus = "oriented" in methods.values()
    turned = inertial_rotations(chain, raw, pose, alignment) if needs_imus else {}
    return CenterChoice(methods, turned)


def _earlier_lags(
    previous: Calibration | None, tracked: Mapping[str, tuple[float, float]] | None
) -> dict[str, SensorLag]:
    """Return the stored lags, or the tracked lags if they have a smaller standard deviation."""
    stored = {} if previous is None else previous.lag_ns
    seen = tracked_lags(tracked or {})
    kept = {
        name: SensorLag(lag, STORED_SD_NS, "stored")
        for name, lag in stored.items()
        if name not in seen or (seen[name].sigma_ns or 0.0) >= STORED_SD_NS
    }
    return seen | kept


def _lags_in_use(
    chain: Chain,
    moving: Mapping[str, LagEstimate],
    alignment: PlateAlignment | None,
    earlier: Mapping[str, SensorLag],
    known: Mapping[str, int],
) -> dict[str, SensorLag]:
    """Return the lag of each sensor, from the first source that has one.

    The sources are the configuration, then movement and plate together, then earlier lags.
    """
    plate = {} if alignment is None else alignment.quality
    prior = {
        name: (
            item.lag_ns,
            item.lag_sigma_ns or (STORED_SD_NS if item.kind == "stored" else PLATE_SD_NS),
        )
        for name, item in plate.items()
        if item.lag_ns is not None
    }

    lags = dict(earlier)
    for group in chain.sensors:
        lags |= segment_lags(
            {name: moving[name] for name in group if name in moving},
            {name: prior[name] for name in group if name in prior},
        )
    return lags | {n: SensorLag(lag, None, "known") for n, lag in known.items()}


def _sensors(
    chain: Chain,
    pose: StaticPose,
    alignment: PlateAlignment | None,
    anatomy: Anatomy,
    lags: Mapping[str, SensorLag],
) -> dict[str, SensorCalibration]:
    out = {}
    for segment, group in zip(chain.segments, chain.sensors, strict=True):
        q_static = as_quaternion(anatomy.q_static[segment])
        for s in group:
            world: Quaternion = (1.0, 0.0, 0.0, 0.0) if alignment is None else alignment.world(s)
            lag_ns = lags.get(s, NO_LAG).lag_ns
            out[s] = sensor_calibration(pose.sensors[s], world, q_static, lag_ns)
    return out


def _training(
    chain: Chain,
    functional: CalibrationTrial,
    tracks: Mapping[str, ClusterTrack],
    anatomy: Anatomy,
    sensors: Mapping[str, SensorCalibration],
    *,
    alignment: PlateAlignment | None,
) -> tuple[LimbTraining, list[str]]:
    """Return the training frames, and notes about missing data and rotated worlds."""
    training, raw, missing = limb_training(chain, functional, tracks, anatomy, sensors)
    notes = [*missing]
    if alignment is not None:
        return training, notes

    # Note the sensors whose world seems rotated; the angle includes soft-tissue artefact.
    for segment, group in zip(chain.segments, chain.sensors, strict=True):
        for s in group:
            found = fit_sensor_alignment("heading", raw[s], training.reference[segment])
            turn = float(rotation.heading_of(found.q_world))
            if abs(turn) > MISALIGNED:
                notes.append(
                    f"{s}: its world seems rotated by about {np.rad2deg(turn):.0f} deg relative to "
                    "the optical world; run the align phase"
                )
    return training, notes


def _models(
    chain: Chain, training: LimbTraining, settings: CalibrationSettings
) -> tuple[Mapping[str, Mapping[str, SegmentModel]], HoldoutQuality]:
    """Return the models of the procedure, and the errors of all methods on the held-out part."""
    method, share = settings.method, settings.holdout_share
    holdout = evaluate_methods(chain, training, method, share, settings.procedure)
    if settings.procedure == "patent":
        return fit_verified_models(chain, training, method, share), holdout
    return fit_models(chain, training, method), holdout


def _segments(
    anatomy: Anatomy, models: Mapping[str, Mapping[str, SegmentModel]]
) -> dict[str, SegmentCalibration]:
    return {
        name: SegmentCalibration(as_quaternion(q), *anatomy.lengths[name], models[name])
        for name, q in anatomy.q_static.items()
    }
