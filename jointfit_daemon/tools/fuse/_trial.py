"""Reads the trials of `jointfit fuse`: sensor orientations and reference segment orientations.

Invariant: returned trials have z up. Reference orientations are interpolated to the sample times of
the sensors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration import CalibrationSettings, OpticalTrack
from jointfit_daemon.calibration.anatomy import static_cluster, track_cluster
from jointfit_daemon.calibration.phases import OfflineTrial, mounts_of
from jointfit_daemon.calibration.registration import orientations_at, robust_mean
from jointfit_daemon.files.axes import quaternions_to_z_up
from jointfit_daemon.files.mocap import read_marker_trial
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import MIN_MARKERS, visible
from jointfit_daemon.model import Chain
from jointfit_daemon.nearest_name import unknown_name
from jointfit_daemon.tools.fuse._tables import (
    FEWEST,
    OrientationRecording,
    UnusableInputError,
    check_unit_norm,
    read_recording,
    select_references,
    select_sensors,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.registration import RobustMean
    from jointfit_daemon.files.axes import Axis
    from jointfit_daemon.limb_model import MarkerCluster


MARKER_FILES = (".trc", ".c3d")
SMALLEST_M, LARGEST_M = 0.01, 2.0
"""Plausible extent of the markers of one segment, m; other values indicate wrong units."""
STILL = np.deg2rad(3.0)
"""Largest robust standard deviation of orientation in a static trial, rad."""


@dataclass(frozen=True, slots=True)
class LimbDescription:
    """Limb that the command-line options describe."""

    chain: Chain
    bones: Mapping[str, str]
    """Name of each segment in reference files."""
    markers: Mapping[str, tuple[str, ...]]
    """Marker names by segment, for marker files."""
    up: Axis
    """Vertical axis of STO files."""


@dataclass(frozen=True, slots=True)
class StaticMarkers:
    """Marker positions on each segment from a static trial.

    Segment axes equal world axes in the static pose.
    """

    clusters: Mapping[str, MarkerCluster]


def read_limb(
    segments: Sequence[str], joints: str | None, markers: Sequence[str], up: Axis
) -> LimbDescription:
    """Parse the options ``--segment``, ``--joints`` and ``--markers``, proximal segment first."""
    names: list[str] = []
    sensors: list[tuple[str, ...]] = []
    bones: dict[str, str] = {}
    for text in segments:
        name, equals, rest = text.partition("=")
        sensor_list, _, bone = rest.partition(":")
        group = tuple(part.strip() for part in sensor_list.split(",") if part.strip())
        if not equals or not name.strip() or not group:
            raise UnusableInputError(
                f"--segment {text!r}: expected NAME=SENSOR,SENSOR or NAME=SENSOR,SENSOR:BONE"
            )
        names.append(name.strip())
        sensors.append(group)
        bones[names[-1]] = bone.strip() or names[-1]

    for what in (names, [sensor for group in sensors for sensor in group]):
        if repeated := sorted({name for name in what if what.count(name) > 1}):
            raise UnusableInputError(
                f"--segment: {', '.join(repeated)} appears more than once, expected unique names"
            )

    given = tuple(part.strip() for part in (joints or "").split(",") if part.strip())
    if given and len(given) != len(names) + 1:
        raise UnusableInputError(
            f"--joints {joints!r}: expected {len(names) + 1} names, one more than segments"
        )

    joint_names = given or tuple(f"O{k + 1}" for k in range(len(names) + 1))
    chain = Chain(joint_names, tuple(names), tuple(sensors))
    return LimbDescription(chain, bones, _markers(markers, names), up)


def _markers(texts: Sequence[str], segments: Sequence[str]) -> dict[str, tuple[str, ...]]:
    found = {}
    for text in texts:
        name, _, rest = text.partition("=")
        if name not in segments:
            raise UnusableInputError(
                f"--markers {text!r}: {unknown_name('segment', name, segments)}"
            )
        found[name] = tuple(part.strip() for part in rest.split(",") if part.strip())
    return found


def read_trial(
    sensors: Path, reference: Path | None, limb: LimbDescription, static: StaticMarkers | None
) -> OfflineTrial:
    """Read one trial; the reference is in the file of the sensors or in a separate file.

    Raises
    ------
    UnusableInputError
        Missing columns, implausible units, or too few common samples.
    """
    table = read_recording(sensors, limb.up)
    q = select_sensors(table, sensors_of(limb.chain), sensors)
    if reference is None or reference.suffix.lower() not in MARKER_FILES:
        found = table if reference is None else read_recording(reference, limb.up)
        where = sensors if reference is None else reference
        bones = select_references(found, list(limb.bones.values()), where)
        by_segment = {segment: bones[bone] for segment, bone in limb.bones.items()}
        t_s = found.t_s
    else:
        t_s, by_segment = _by_markers(reference, limb, static)

    resampled = {s: _at(t_s, values, table.t_s) for s, values in by_segment.items()}
    trial = OfflineTrial(sensors.stem, table.t_s, q, resampled)
    for segment, values in resampled.items():
        seen = int(np.isfinite(values).all(axis=1).sum())
        if seen >= FEWEST:
            continue
        apart = trial.t_s[-1] < t_s[0] or t_s[-1] < trial.t_s[0]
        raise UnusableInputError(
            f"{sensors}: {segment} has {seen} samples in common with its reference "
            f"{reference or sensors}, expected at least {FEWEST}: sensors "
            f"{trial.t_s[0]:.2f} to {trial.t_s[-1]:.2f} s, reference {t_s[0]:.2f} to "
            f"{t_s[-1]:.2f} s; "
            + (
                "start both clocks at the same instant"
                if apart
                else "the reference has only gaps there: omit the trial"
            )
        )

    return trial


def sensors_of(chain: Chain) -> list[str]:
    """Return the names of all sensors of a chain, segment by segment."""
    return [name for group in chain.sensors for name in group]


def name_trials(trials: Sequence[OfflineTrial], paths: Sequence[Path]) -> list[OfflineTrial]:
    """Return the trials with unique names; files with equal stems are named by their path.

    Raises
    ------
    UnusableInputError
        A file is given twice, so the hold-out data would be part of the fit.
    """
    if twice := sorted({str(path) for path in paths if paths.count(path) > 1}):
        raise UnusableInputError(f"{', '.join(twice)}: given more than once: give each trial once")

    names = [trial.name for trial in trials]
    return [
        replace(trial, name=str(path)) if names.count(trial.name) > 1 else trial
        for trial, path in zip(trials, paths, strict=True)
    ]


def read_available_sensors(
    path: Path, chain: Chain, up: Axis, without: Sequence[str]
) -> OrientationRecording:
    """Read the sensors of a chain except the sensors in `without`.

    Raises
    ------
    UnusableInputError
        A sensor is missing from the file, or the chain has no sensor with a name in `without`.
    """
    sensors = sensors_of(chain)
    if strange := [name for name in without if name not in sensors]:
        problems = "; ".join(unknown_name("sensor", name, sensors) for name in strange)
        raise UnusableInputError(f"--without: the model has {problems}")

    table = read_recording(path, up)
    wanted = [name for name in sensors if name not in without]
    if missing := [name for name in wanted if name not in table.q]:
        problems = "; ".join(unknown_name("sensor", name, table.q) for name in missing)
        raise UnusableInputError(f"{path}: {problems}; to ignore it: --without {missing[0]}")

    return OrientationRecording(table.t_s, {name: table.q[name] for name in wanted}, table.bones)


def read_static(
    sensors: Path, reference: Path | None, limb: LimbDescription
) -> tuple[dict[str, Array], StaticMarkers | None]:
    """Estimate sensor alignments from a static trial, and the marker positions on the segments.

    If the reference consists of markers, or if the static trial has no reference, segment axes
    equal world axes in the static pose. A JSON file of alignments can replace the sensor file of
    the static trial.

    Raises
    ------
    UnusableInputError
        The errors of `read_trial`, or the subject moved.
    """
    by_markers = reference is not None and reference.suffix.lower() in MARKER_FILES
    markers = None
    if reference is not None and by_markers:
        track, settings = _optical(reference, limb)
        clusters = {s: static_cluster(track, s, settings) for s in limb.chain.segments}
        turns = {name: track_cluster(track, cluster).q for name, cluster in clusters.items()}
        _check_stillness(reference, {name: robust_mean(q) for name, q in turns.items()})
        markers = StaticMarkers(clusters)
    if sensors.suffix.lower() == ".json":
        return read_mounts(sensors, limb.chain), markers

    table = read_recording(sensors, limb.up)
    q = select_sensors(table, sensors_of(limb.chain), sensors)
    if reference is not None and not by_markers:
        trial = read_trial(sensors, reference, limb, None)
    elif not by_markers and set(limb.bones.values()) <= set(table.bones):
        trial = read_trial(sensors, None, limb, None)
    else:
        upright = np.tile(rotation.IDENTITY, (len(table.t_s), 1))
        axes = dict.fromkeys(limb.chain.segments, upright)
        trial = OfflineTrial(sensors.stem, table.t_s, q, axes)

    found = mounts_of(limb.chain, [trial])
    _check_stillness(sensors, found)
    return {name: mean.q for name, mean in found.items()}, markers


def _check_stillness(path: Path, found: Mapping[str, RobustMean]) -> None:
    moved = {name: mean.spread for name, mean in found.items() if mean.spread > STILL}
    if moved:
        motion = ", ".join(f"{name} {np.rad2deg(angle):.0f} deg" for name, angle in moved.items())
        raise UnusableInputError(
            f"{path}: orientation varies by {motion} (robust standard deviation), expected at "
            f"most {np.rad2deg(STILL):.0f} deg in a static trial: select a part in which the"
            " subject stands still, or omit --static"
        )


def read_mounts(path: Path, chain: Chain) -> dict[str, Array]:
    """Read sensor alignments from JSON, ``{"q_bias": {SENSOR: [w, x, y, z]}, "up": "y"}``.

    The vertical axis ``up`` is ``y`` (default) or ``z``.
    """
    from jointfit_daemon.files.text import MalformedFileError, read_json

    try:
        data = read_json(path)
    except MalformedFileError as fault:
        raise UnusableInputError(str(fault)) from fault
    mounts = data.get("q_bias") if isinstance(data, dict) else None
    if not isinstance(mounts, dict):
        raise UnusableInputError(f'{path}: expected {{"q_bias": {{SENSOR: [w, x, y, z]}}}}')
    found = {}
    for name in sensors_of(chain):
        if name not in mounts:
            raise UnusableInputError(f"{path}: {unknown_name('sensor', name, mounts)}")
        q = np.asarray(mounts[name], dtype=np.float64)
        check_unit_norm(path, name, q[None])
        found[name] = rotation.normalize(q) if data.get("up") == "z" else quaternions_to_z_up(q)
    return found


def _ns(t_s: Array) -> NDArray[np.int64]:
    return np.round(t_s * 1e9).astype(np.int64)


def _at(t_s: Array, q: Array, wanted_s: Array) -> Array:
    """Interpolate orientations to the times `wanted_s`; the result is NaN within gaps of `t_s`."""
    if len(t_s) == len(wanted_s) and np.array_equal(t_s, wanted_s):
        return q
    return orientations_at(_ns(t_s), q, _ns(wanted_s))


def _optical(path: Path, limb: LimbDescription) -> tuple[OpticalTrack, CalibrationSettings]:
    for segment in limb.chain.segments:
        if segment not in limb.markers:
            raise UnusableInputError(
                f"{path}: no markers of segment {segment!r}: add --markers {segment}=M1,M2,M3"
            )

    trial = read_marker_trial(path)
    names = tuple(dict.fromkeys(name for group in limb.markers.values() for name in group))
    positions = trial.points(names)  # this call reports all unknown names together
    for segment in limb.chain.segments:
        seen = positions[:, [names.index(name) for name in limb.markers[segment]]]
        seen = seen[visible(seen).all(axis=1)]
        if not len(seen):
            continue
        widest = float(np.median(np.ptp(seen, axis=1).max(axis=-1)))
        if not SMALLEST_M <= widest <= LARGEST_M:
            raise UnusableInputError(
                f"{path}: the markers of {segment} extend over {widest:.3g} m, expected "
                f"{SMALLEST_M:g} to {LARGEST_M:g} m: check the units stated in the file"
            )

    empty = np.empty((len(positions), 0, 3))
    track = OpticalTrack(
        _ns(trial.trajectories.t_s),
        names,
        positions,
        (),
        empty,
        np.empty((len(positions), 0, 4)),
        trial.residuals(names),
    )
    return track, CalibrationSettings(markers=dict(limb.markers))


def _by_markers(
    path: Path, limb: LimbDescription, static: StaticMarkers | None
) -> tuple[Array, dict[str, Array]]:
    if static is None:
        raise UnusableInputError(
            f"{path}: markers do not define segment axes: add a static trial with the same "
            "markers, --static SENSORS=MARKERS"
        )

    track, _ = _optical(path, limb)
    turned = {}
    for name, cluster in static.clusters.items():
        turned[name] = track_cluster(track, cluster).q
        places = track.positions[:, [track.markers.index(marker) for marker in cluster.markers]]
        seen = np.count_nonzero(visible(places).sum(axis=1) >= MIN_MARKERS)
        if seen >= FEWEST > np.count_nonzero(visible(turned[name])):
            raise UnusableInputError(
                f"{path}: the marker distances of {name} differ from the static trial: check for "
                "swapped names, another subject, or a wrong unit in the file"
            )

    return np.asarray(track.t_ns / 1e9), turned
