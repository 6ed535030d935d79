"""The fits of the worker process: typed jobs in, JSON-able results out.

A rejected calibration is a result with ``refused``; any other exception is a bug.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from jointfit_daemon import __version__
from jointfit_daemon.calibration._errors import CalibrationError
from jointfit_daemon.calibration.phases._acceptance import compare_calibrations
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
from jointfit_daemon.limb_model import Calibration

if TYPE_CHECKING:
    from collections.abc import Mapping


def run_job(kind: str, payload: Mapping[str, Any]) -> dict[str, Any]:
    """Run one fit.

    Parameters
    ----------
    kind : str
        ``align``, ``static``, ``functional`` or ``online``.
    payload : mapping
        ``chain`` and ``settings``; the trials ``trial`` (align), ``static``, ``functional``;
        ``alignment`` and ``previous`` as dicts or None; ``fresh`` frames (online).

    Returns
    -------
    dict
        ``quality`` and what the kind gives: ``alignment``, ``calibration`` (dicts), ``worse`` (why
        the stored calibration is better), ``notes`` (how sensors were re-donned);
        or ``refused`` with the reason alone.
    """
    try:
        return _JOBS[kind](payload)
    except CalibrationError as refusal:
        return {"refused": str(refusal)}


def _alignment(payload: Mapping[str, Any]) -> Any:
    """Return the alignment of this session, else the one of the calibration in force, else None."""
    if payload.get("alignment") is not None:
        return PlateAlignment.from_dict(payload["alignment"])
    previous = _previous(payload)
    if previous is None or "headings_from_static" in previous.flags:
        return None
    # Worlds are a matter of the room, not of the wearer: they outlive a calibration.
    return PlateAlignment(
        {
            name: AlignedSensor(item.q_optical_world, "stored", 0.0, 0.0, 0.0, item.lag_ns)
            for name, item in previous.sensor.items()
        }
    )


def _previous(payload: Mapping[str, Any]) -> Any:
    stored = payload.get("previous")
    if stored is None:
        return None
    calibration = Calibration.from_dict(stored)
    return calibration if calibration.fits(payload["chain"]) else None


def _newer_worlds(payload: Mapping[str, Any], previous: Calibration) -> PlateAlignment | None:
    """Return the alignment of this session, if the models of `previous` live in such worlds."""
    if payload.get("alignment") is None or "headings_from_static" in previous.flags:
        return None
    return PlateAlignment.from_dict(payload["alignment"])


def _align(payload: Mapping[str, Any]) -> dict[str, Any]:
    heard = payload["trial"].sensors
    missing = [s for group in payload["chain"].sensors for s in group if s not in heard]
    if missing:  # later phases would have to refuse what this one let pass
        raise CalibrationError(
            *(f"{name}: no data while the plate was turned; switch it on" for name in missing)
        )
    found = fit_plate_alignment(payload["trial"], payload["settings"], lag_ns=payload.get("lag_ns"))
    return {"alignment": found.to_dict(), "quality": found.quality}


def _static(payload: Mapping[str, Any]) -> dict[str, Any]:
    chain, settings = payload["chain"], payload["settings"]
    pose = fit_static(payload["static"], settings, chain)
    result: dict[str, Any] = {"quality": pose.quality}
    previous, markers = _previous(payload), bool(settings.markers or settings.rigid_bodies)
    if previous is not None:
        calibration = with_new_static(previous, pose, _newer_worlds(payload, previous))
        before, after = (
            {name: item.q_sensor_segment for name, item in one.sensor.items()}
            for one in (previous, calibration)
        )
        groups = dict(zip(chain.segments, chain.sensors, strict=True))
        result["notes"] = list(redonning_notes(before, after, groups))
    elif not markers:  # no cameras: a static pose is all there will ever be
        calibration = fit_static_only(pose, _alignment(payload), chain, software=__version__)
    else:
        return result
    return result | {"calibration": calibration.to_dict()}


def _functional(payload: Mapping[str, Any]) -> dict[str, Any]:
    found = fit_calibration(
        payload["static"],
        payload["functional"],
        _alignment(payload),
        payload["settings"],
        payload["chain"],
        software=__version__,
        lag_ns=payload.get("lag_ns"),
        tracked=payload.get("tracked"),
        previous=_previous(payload),
    )
    result: dict[str, Any] = {"quality": dict(found.quality), "calibration": found.to_dict()}
    previous = _previous(payload)
    if previous is not None:
        wins, why = compare_calibrations(found, previous)
        if not wins:
            result["worse"] = why
    return result


def _online(payload: Mapping[str, Any]) -> dict[str, Any]:
    previous = _previous(payload)
    if previous is None:
        raise CalibrationError("no calibration of this limb to go on from")
    return refit_models(previous, payload["fresh"], payload["chain"], software=__version__)


_JOBS = {"align": _align, "static": _static, "functional": _functional, "online": _online}
