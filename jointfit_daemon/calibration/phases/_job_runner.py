"""Fits that the worker process runs, with one function for each class of job.

If a fit raises `CalibrationError`, the result contains the text of the error in ``refused``. Any
other exception is a bug.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon import __version__
from jointfit_daemon.calibration._errors import CalibrationError
from jointfit_daemon.calibration._jobs import (
    AlignJob,
    CalibrationJob,
    FitResult,
    FunctionalJob,
    JobControl,
    RefitJob,
    StaticJob,
)
from jointfit_daemon.calibration._quality import WorldQuality, quality_table
from jointfit_daemon.calibration.phases._acceptance import compare_calibrations
from jointfit_daemon.calibration.phases._chain_refinement import with_refined_chain
from jointfit_daemon.calibration.phases._functional import fit_calibration
from jointfit_daemon.calibration.phases._online import refit_models
from jointfit_daemon.calibration.phases._plate_alignment import (
    AlignedSensor,
    PlateAlignment,
    fit_plate_alignment,
)
from jointfit_daemon.calibration.phases._static_pose import (
    fit_static,
    fit_static_only,
    with_new_static,
)
from jointfit_daemon.calibration.registration import redonning_notes
from jointfit_daemon.model import FrameFlag

if TYPE_CHECKING:
    from jointfit_daemon.limb_model import Calibration


def run_job(job: CalibrationJob, control: JobControl | None = None) -> FitResult:
    """Run one fit and return its result, or the reason why the fit was rejected."""
    try:
        match job:
            case AlignJob():
                return _align(job)
            case StaticJob():
                return _static(job)
            case FunctionalJob():
                return _functional(job, control or JobControl())
            case RefitJob():
                return _refit(job)
    except CalibrationError as refusal:
        return FitResult(refused=str(refusal))


def _align(job: AlignJob) -> FitResult:
    sensors = [sensor for group in job.chain.sensors for sensor in group]
    missing = [sensor for sensor in sensors if sensor not in job.trial.sensors]
    if missing:  # otherwise only later phases would reject the alignment
        raise CalibrationError(
            *(f"{name}: no data while the plate was turned; switch it on" for name in missing)
        )
    found = fit_plate_alignment(job.trial, job.settings, lag_ns=job.lag_ns)
    return FitResult(quality_table(found.quality), alignment=found.to_dict())


def _static(job: StaticJob) -> FitResult:
    chain, settings, previous = job.chain, job.settings, _previous(job)
    pose = fit_static(job.static, settings, chain)
    if previous is None:
        if settings.markers or settings.rigid_bodies:
            return FitResult(quality_table(pose.quality))
        # Without cameras the calibration consists of the static pose alone.
        found = fit_static_only(pose, _alignment(job), chain, software=__version__)
        return FitResult(quality_table(pose.quality), calibration=found)

    # The alignment of this session applies only if the models of `previous` refer to aligned
    # worlds.
    alignment = None
    if job.alignment is not None and FrameFlag.HEADINGS_FROM_STATIC not in previous.flags:
        alignment = PlateAlignment.from_dict(job.alignment)
    found = with_new_static(previous, pose, alignment)
    before, after = (
        {name: item.q_sensor_segment for name, item in one.sensor.items()}
        for one in (previous, found)
    )
    groups = dict(zip(chain.segments, chain.sensors, strict=True))
    notes = tuple(redonning_notes(before, after, groups))
    return FitResult(quality_table(pose.quality), calibration=found, notes=notes)


def _functional(job: FunctionalJob, control: JobControl) -> FitResult:
    previous = _previous(job)
    found = fit_calibration(
        job.static,
        job.functional,
        _alignment(job),
        job.settings,
        job.chain,
        software=__version__,
        lag_ns=job.lag_ns,
        tracked=job.tracked,
        previous=previous,
    )
    found = with_refined_chain(found, job.functional, job.settings, control)
    worse = None
    if previous is not None:
        better, reason = compare_calibrations(found, previous)
        worse = None if better else reason
    return FitResult(found.quality, calibration=found, worse=worse)


def _refit(job: RefitJob) -> FitResult:
    previous = _previous(job)
    if previous is None:
        raise CalibrationError(
            "no calibration of this limb is in force: repeat the functional phase"
        )
    return refit_models(previous, job.fresh, job.chain, software=__version__)


def _previous(job: StaticJob | FunctionalJob | RefitJob) -> Calibration | None:
    """Return the current calibration if it belongs to the same limb and sensors."""
    previous = job.previous
    return previous if previous is not None and previous.fits(job.chain) else None


def _alignment(job: StaticJob | FunctionalJob) -> PlateAlignment | None:
    """Return the alignment of this session or of the current calibration; None without either."""
    if job.alignment is not None:
        return PlateAlignment.from_dict(job.alignment)
    previous = _previous(job)
    if previous is None or FrameFlag.HEADINGS_FROM_STATIC in previous.flags:
        return None
    # Alignments of sensor worlds remain valid, because they do not depend on the sensor mounts.
    return PlateAlignment(
        {
            name: AlignedSensor(
                item.q_optical_world, WorldQuality("stored", 0.0, 0.0, 0.0, item.lag_ns, None)
            )
            for name, item in previous.sensor.items()
        }
    )
