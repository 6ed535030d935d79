"""Trials of `jointfit fuse` from files: orientations of sensors, and a reference of the segments.

Law: what leaves here has z up and one time axis, the sensors'.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration import CalibrationSettings, OpticalTrack
from jointfit_daemon.calibration.anatomy import static_cluster, track_cluster
from jointfit_daemon.calibration.phases import OfflineTrial, mounts_of
from jointfit_daemon.calibration.registration import orientations_at, robust_mean
from jointfit_daemon.files.mocap import read_marker_trial
from jointfit_daemon.files.orientations import quaternions_z_up
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import MIN_MARKERS, visible
from jointfit_daemon.model import Chain
from jointfit_daemon.nearest_name import unknown_name
from jointfit_daemon.tools.fuse._tables import (
    FEWEST,
    Table,
    Unusable,
    bones_of,
    read_table,
    refuse_other_units,
    sensors_of,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.registration import RobustMean
    from jointfit_daemon.files.mocap import Axis
    from jointfit_daemon.limb_model import Cluster


MARKER_FILES = (".trc", ".c3d")
SMALLEST_M, LARGEST_M = 0.01, 2.0
"""Extent of the markers of one segment."""
STILL = np.deg2rad(3.0)
"""Robust scatter of a sensor in a trial that may be called still."""


@dataclass(frozen=True, slots=True)
class Limb:
    """What the command line says of the limb."""

    chain: Chain
    bones: Mapping[str, str]
    """Name of each segment in files of reference orientations."""
    markers: Mapping[str, tuple[str, ...]]
    """Markers of each segment, for marker files."""
    up: Axis
    """Upward axis of STO files."""


@dataclass(frozen=True, slots=True)
class StaticMarkers:
    """Where the markers sit on each segment whose axes are the world's, from a still trial."""

    clusters: Mapping[str, Cluster]


def read_limb(
    segments: Sequence[str], joints: str | None, markers: Sequence[str], up: Axis
) -> Limb:
    """Return the limb of ``NAME=SENSOR,SENSOR[:BONE]`` texts, from proximal to distal."""
    names: list[str] = []
    sensors: list[tuple[str, ...]] = []
    bones: dict[str, str] = {}
    for text in segments:
        name, equals, rest = text.partition("=")
        worn, _, bone = rest.partition(":")
        group = tuple(part.strip() for part in worn.split(",") if part.strip())
        if not equals or not name.strip() or not group:
            raise Unusable(
                f"--segment {text!r}: expected NAME=SENSOR,SENSOR or NAME=SENSOR,SENSOR:BONE"
            )
        names.append(name.strip())
        sensors.append(group)
        bones[names[-1]] = bone.strip() or names[-1]
    for what in (names, [sensor for group in sensors for sensor in group]):
        if repeated := sorted({name for name in what if what.count(name) > 1}):
            raise Unusable(f"--segment: {', '.join(repeated)} is named more than once")
    said = tuple(part.strip() for part in (joints or "").split(",") if part.strip())
    if said and len(said) != len(names) + 1:
        raise Unusable(
            f"--joints {joints!r}: expected {len(names) + 1} names, one more than segments"
        )
    joint_names = said or tuple(f"O{k + 1}" for k in range(len(names) + 1))
    chain = Chain(joint_names, tuple(names), tuple(sensors))
    return Limb(chain, bones, _markers(markers, names), up)


def _markers(texts: Sequence[str], segments: Sequence[str]) -> dict[str, tuple[str, ...]]:
    found = {}
    for text in texts:
        name, _, rest = text.partition("=")
        if name not in segments:
            raise Unusable(f"--markers {text!r}: {unknown_name('segment', name, segments)}")
        found[name] = tuple(part.strip() for part in rest.split(",") if part.strip())
    return found


def read_trial(
    sensors: Path, reference: Path | None, limb: Limb, static: StaticMarkers | None
) -> OfflineTrial:
    """Return one trial: sensors of one file, reference of the same or of another.

    Raises
    ------
    Unusable
        Columns that are not there (with the nearest spelling), units that cannot be, too little in
        common.
    """
    table = read_table(sensors, limb.up)
    q = sensors_of(table, [s for group in limb.chain.sensors for s in group], sensors)
    if reference is None or reference.suffix.lower() not in MARKER_FILES:
        found = table if reference is None else read_table(reference, limb.up)
        where = sensors if reference is None else reference
        bones = bones_of(found, list(limb.bones.values()), where)
        by_segment = {segment: bones[bone] for segment, bone in limb.bones.items()}
        t_s = found.t_s
    else:
        t_s, by_segment = _by_markers(reference, limb, static)
    resampled = {s: _at(t_s, values, table.t_s) for s, values in by_segment.items()}
    trial = OfflineTrial(sensors.stem, table.t_s, q, resampled)
    _refuse_too_little(trial, t_s, sensors, reference)
    return trial


def read_sensors(path: Path, chain: Chain, up: Axis) -> Table:
    """Return the orientations of a chain's sensors; `Unusable` as `read_trial`."""
    table = read_table(path, up)
    q = sensors_of(table, [s for group in chain.sensors for s in group], path)
    return Table(table.t_s, q, table.bones)


def told_apart(trials: Sequence[OfflineTrial], paths: Sequence[Path]) -> list[OfflineTrial]:
    """Return the trials, named by their whole paths where two files are called alike.

    Raises
    ------
    Unusable
        One file is named twice: what is left out would be fitted to.
    """
    if twice := sorted({str(path) for path in paths if paths.count(path) > 1}):
        raise Unusable(f"{', '.join(twice)}: named more than once; each trial counts once")
    names = [trial.name for trial in trials]
    return [
        replace(trial, name=str(path)) if names.count(trial.name) > 1 else trial
        for trial, path in zip(trials, paths, strict=True)
    ]


def read_worn(path: Path, chain: Chain, up: Axis, without: Sequence[str]) -> Table:
    """Return what of a chain's sensors there is, to be fused around what is not.

    Raises
    ------
    Unusable
        A sensor that is not in the file and not in `without` either, or nobody in either.
    """
    everyone = [s for group in chain.sensors for s in group]
    if strange := [name for name in without if name not in everyone]:
        told = "; ".join(unknown_name("sensor", name, everyone) for name in strange)
        raise Unusable(f"--without: the model has {told}")
    table = read_table(path, up)
    wanted = [name for name in everyone if name not in without]
    if missing := [name for name in wanted if name not in table.q]:
        told = "; ".join(unknown_name("sensor", name, table.q) for name in missing)
        raise Unusable(f"{path}: {told}; --without {missing[0]} goes on without it")
    return Table(table.t_s, {name: table.q[name] for name in wanted}, table.bones)


def read_static(
    sensors: Path, reference: Path | None, limb: Limb
) -> tuple[dict[str, Array], StaticMarkers | None]:
    """Return the mounts of all sensors from a still trial, and where the markers are on it.

    With markers, or without any reference, segment axes are the world's in that pose. Mounts of a
    JSON file stand for a still trial of the sensors.

    Raises
    ------
    Unusable
        As `read_trial`, or somebody moved.
    """
    by_markers = reference is not None and reference.suffix.lower() in MARKER_FILES
    markers = _static_markers(reference, limb) if reference is not None and by_markers else None
    if sensors.suffix.lower() == ".json":
        return read_mounts(sensors, limb.chain), markers
    table = read_sensors(sensors, limb.chain, limb.up)
    if reference is not None and not by_markers:
        trial = read_trial(sensors, reference, limb, None)
    elif not by_markers and set(limb.bones.values()) <= set(table.bones):
        trial = read_trial(sensors, None, limb, None)
    else:
        upright = np.tile(rotation.IDENTITY, (len(table.t_s), 1))
        axes = dict.fromkeys(limb.chain.segments, upright)
        trial = OfflineTrial(sensors.stem, table.t_s, table.q, axes)
    found = mounts_of(limb.chain, [trial])
    _refuse_moving(sensors, found)
    return {name: mean.q for name, mean in found.items()}, markers


def _static_markers(path: Path, limb: Limb) -> StaticMarkers:
    track, settings = _optical(path, limb)
    clusters = {s: static_cluster(track, s, settings) for s in limb.chain.segments}
    turns = {name: track_cluster(track, cluster).q for name, cluster in clusters.items()}
    _refuse_moving(path, {name: robust_mean(q) for name, q in turns.items()})
    return StaticMarkers(clusters)


def _refuse_moving(path: Path, found: Mapping[str, RobustMean]) -> None:
    moved = {name: mean.spread for name, mean in found.items() if mean.spread > STILL}
    if moved:
        told = ", ".join(f"{name} by {np.rad2deg(angle):.0f} deg" for name, angle in moved.items())
        raise Unusable(
            f"{path}: a still trial is wanted, and here somebody moves: {told} (robust scatter); "
            "cut out the part in which the person stands still, or leave out --static"
        )


def read_mounts(path: Path, chain: Chain) -> dict[str, Array]:
    """Return mounts from a JSON file ``{"q_bias": {SENSOR: [w, x, y, z]}, "up": "y"}``."""
    from jointfit_daemon.files.text import MalformedFileError, read_json

    try:
        said = read_json(path)
    except MalformedFileError as fault:
        raise Unusable(str(fault)) from fault
    mounts = said.get("q_bias") if isinstance(said, dict) else None
    if not isinstance(mounts, dict):
        raise Unusable(f'{path}: expected {{"q_bias": {{SENSOR: [w, x, y, z]}}}}')
    found = {}
    for name in (s for group in chain.sensors for s in group):
        if name not in mounts:
            raise Unusable(f"{path}: {unknown_name('sensor', name, mounts)}")
        q = np.asarray(mounts[name], dtype=np.float64)
        refuse_other_units(path, name, q[None])
        found[name] = rotation.normalize(q) if said.get("up") == "z" else quaternions_z_up(q)
    return found


def _ns(t_s: Array) -> NDArray[np.int64]:
    return np.round(t_s * 1e9).astype(np.int64)


def _at(t_s: Array, q: Array, wanted_s: Array) -> Array:
    """Return orientations at other instants; never across a gap."""
    if len(t_s) == len(wanted_s) and np.array_equal(t_s, wanted_s):
        return q
    return orientations_at(_ns(t_s), q, _ns(wanted_s))


def _optical(path: Path, limb: Limb) -> tuple[OpticalTrack, CalibrationSettings]:
    for segment in limb.chain.segments:
        if segment not in limb.markers:
            raise Unusable(
                f"{path}: which markers are on {segment!r}? --markers {segment}=M1,M2,M3"
            )
    trial = read_marker_trial(path)
    names = tuple(dict.fromkeys(name for group in limb.markers.values() for name in group))
    positions = trial.points(names)  # all unknown names at once
    _refuse_other_sizes(path, limb, names, positions)
    empty = np.empty((len(positions), 0, 3))
    track = OpticalTrack(
        _ns(trial.trajectories.t_s), names, positions, (), empty, np.empty((len(positions), 0, 4))
    )
    return track, CalibrationSettings(markers=dict(limb.markers))


def _by_markers(
    path: Path, limb: Limb, static: StaticMarkers | None
) -> tuple[Array, dict[str, Array]]:
    if static is None:
        raise Unusable(
            f"{path}: markers alone have no segment axes: give a still trial that has them, too, "
            "--static SENSORS=MARKERS"
        )
    track, _ = _optical(path, limb)
    turned = {}
    for name, cluster in static.clusters.items():
        turned[name] = track_cluster(track, cluster).q
        places = track.positions[:, [track.markers.index(marker) for marker in cluster.markers]]
        seen = np.count_nonzero(visible(places).sum(axis=1) >= MIN_MARKERS)
        if seen >= FEWEST > np.count_nonzero(visible(turned[name])):
            raise Unusable(
                f"{path}: the markers of {name} do not lie to each other as in the still trial: "
                "are names swapped, is it another person, or are units others than the file says?"
            )
    return np.asarray(track.t_ns / 1e9), turned


def _refuse_other_sizes(path: Path, limb: Limb, names: Sequence[str], positions: Array) -> None:
    """Refuse markers of a segment that are too far from each other, or too near, for metres."""
    for segment in limb.chain.segments:
        seen = positions[:, [names.index(name) for name in limb.markers[segment]]]
        seen = seen[visible(seen).all(axis=1)]
        if not len(seen):
            continue
        widest = float(np.median(np.ptp(seen, axis=1).max(axis=-1)))
        if not SMALLEST_M <= widest <= LARGEST_M:
            raise Unusable(
                f"{path}: the markers of {segment} spread over {widest:.3g} m: does the file name "
                "its units rightly (m, mm)?"
            )


def _refuse_too_little(
    trial: OfflineTrial, t_s: Array, sensors: Path, reference: Path | None
) -> None:
    for segment, q in trial.reference.items():
        seen = int(np.isfinite(q).all(axis=1).sum())
        if seen >= FEWEST:
            continue
        apart = trial.t_s[-1] < t_s[0] or t_s[-1] < trial.t_s[0]
        raise Unusable(
            f"{sensors}: {segment} has {seen} instants in common with its reference "
            f"{reference or sensors}, at least {FEWEST} are needed: sensors "
            f"{trial.t_s[0]:.2f} to {trial.t_s[-1]:.2f} s, reference {t_s[0]:.2f} to "
            f"{t_s[-1]:.2f} s; "
            + (
                "do both clocks begin at the same instant?"
                if apart
                else "the reference is all gaps there: leave out the trial"
            )
        )
