"""Trials of `jointfit fuse` from files: orientations of sensors, and a reference of the segments.

Law: whatever the files' axes are, what leaves here has z up and one time axis, the sensors'. What
looks like other units is refused with what to change, never converted on a guess.
"""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jointfit_daemon.calibration.markers import static_cluster, track_cluster
from jointfit_daemon.calibration.offline import OfflineTrial, mounts_of
from jointfit_daemon.calibration.sampling import orientations_at
from jointfit_daemon.calibration.trial import CalibrationSettings, OpticalTrack
from jointfit_daemon.files.marker_trial import read_marker_trial
from jointfit_daemon.files.npz import quaternions_z_up, read_orientations_npz
from jointfit_daemon.files.sto import read_orientations_sto
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.model import Chain

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from jointfit_daemon.calibration.markers import Cluster
    from jointfit_daemon.files.marker_trial import Axis

Array = NDArray[np.float64]

MARKER_FILES = (".trc", ".c3d")
SLOWEST_HZ, FASTEST_HZ = 5.0, 20_000.0
NORM_SLACK = 0.05
FEWEST = 30
"""Instants that sensors and reference must share."""


class Unusable(ValueError):  # noqa: N818 - named for what happened
    """A file that is not what was asked for; the message says what to change."""


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
class Table:
    """Orientations over time by name, z up."""

    t_s: Array
    q: Mapping[str, Array]
    """Shape (n, 4) each; NaN where missing."""


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
            raise Unusable(f"--markers {text!r}: {_unknown('segment', name, segments)}")
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
    q = _chosen(table, [s for group in limb.chain.sensors for s in group], "sensor", sensors)
    if reference is None or reference.suffix.lower() not in MARKER_FILES:
        found = table if reference is None else read_table(reference, limb.up)
        where = sensors if reference is None else reference
        bones = _chosen(found, list(limb.bones.values()), "segment", where)
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
    return Table(
        table.t_s, _chosen(table, [s for group in chain.sensors for s in group], "sensor", path)
    )


def read_static(
    sensors: Path, reference: Path | None, limb: Limb
) -> tuple[dict[str, Array], StaticMarkers | None]:
    """Return the mounts of all sensors from a still trial, and where the markers are on it.

    With markers, or without any reference, segment axes are the world's in that pose.
    """
    table = read_sensors(sensors, limb.chain, limb.up)
    clusters = None
    if reference is not None and reference.suffix.lower() in MARKER_FILES:
        track, settings = _optical(reference, limb)
        clusters = {s: static_cluster(track, s, settings) for s in limb.chain.segments}
    if reference is not None and clusters is None:
        trial = read_trial(sensors, reference, limb, None)
    elif clusters is None and set(limb.bones.values()) <= set(read_table(sensors, limb.up).q):
        trial = read_trial(sensors, None, limb, None)
    else:
        upright = np.tile(rotation.IDENTITY, (len(table.t_s), 1))
        axes = dict.fromkeys(limb.chain.segments, upright)
        trial = OfflineTrial(sensors.stem, table.t_s, table.q, axes)
    mounts = {name: mean.q for name, mean in mounts_of(limb.chain, [trial]).items()}
    return mounts, None if clusters is None else StaticMarkers(clusters)


def read_mounts(path: Path, chain: Chain) -> dict[str, Array]:
    """Return mounts from a JSON file ``{"q_bias": {SENSOR: [w, x, y, z]}, "up": "y"}``."""
    import orjson

    try:
        said = orjson.loads(path.read_bytes())
    except orjson.JSONDecodeError as fault:
        raise Unusable(f"{path}: not JSON: {fault}") from fault
    mounts = said.get("q_bias") if isinstance(said, dict) else None
    if not isinstance(mounts, dict):
        raise Unusable(f'{path}: expected {{"q_bias": {{SENSOR: [w, x, y, z]}}}}')
    found = {}
    for name in (s for group in chain.sensors for s in group):
        if name not in mounts:
            raise Unusable(f"{path}: {_unknown('sensor', name, mounts)}")
        q = np.asarray(mounts[name], dtype=np.float64)
        _refuse_other_units(path, name, q[None])
        found[name] = rotation.normalize(q) if said.get("up") == "z" else quaternions_z_up(q)
    return found


def read_table(path: Path, up: Axis) -> Table:
    """Return all orientations of an NPZ or STO file, z up."""
    kind = path.suffix.lower()
    if kind == ".npz":
        trial = read_orientations_npz(path)
        _refuse_npz_units(path)
        table = Table(trial.t_s, {**trial.bones, **trial.sensors})
    elif kind == ".sto":
        said = read_orientations_sto(path)
        columns = {name: said.quaternions[:, k] for k, name in enumerate(said.names)}
        for name, q in columns.items():
            _refuse_other_units(path, name, q)
        turn = quaternions_z_up if up == "y" else rotation.normalize
        table = Table(said.t_s, {name: turn(q) for name, q in columns.items()})
    else:
        raise Unusable(f"{path}: expected orientations in a file that ends in .npz or .sto")
    _refuse_other_times(path, table.t_s)
    return table


def _refuse_npz_units(path: Path) -> None:
    with np.load(path, allow_pickle=False) as arrays:
        for name in arrays.files:
            if name.endswith("_quat") or name.startswith("q_"):
                _refuse_other_units(path, name, np.asarray(arrays[name], dtype=np.float64))


def _refuse_other_units(path: Path, name: str, q: Array) -> None:
    norms = np.linalg.norm(q, axis=-1)
    known = norms[np.isfinite(norms)]
    if known.size and abs(float(np.median(known)) - 1.0) > NORM_SLACK:
        raise Unusable(
            f"{path}: {name}: its four numbers have norm {float(np.median(known)):.3g}, not 1: "
            "expected unit quaternions w, x, y, z, not angles in degrees or radians"
        )


def _refuse_other_times(path: Path, t_s: Array) -> None:
    steps = np.diff(t_s)
    if len(t_s) < FEWEST or not np.isfinite(t_s).all() or (steps <= 0.0).any():
        raise Unusable(
            f"{path}: expected at least {FEWEST} rows whose times grow, found {len(t_s)}"
        )
    rate_hz = 1.0 / float(np.median(steps))
    if not SLOWEST_HZ <= rate_hz <= FASTEST_HZ:
        raise Unusable(
            f"{path}: times {float(np.median(steps)):g} apart would be {rate_hz:.3g} Hz: expected "
            "seconds; are they milliseconds, or frame numbers?"
        )


def _chosen(table: Table, names: Sequence[str], what: str, path: Path) -> dict[str, Array]:
    if missing := [name for name in names if name not in table.q]:
        raise Unusable(f"{path}: {'; '.join(_unknown(what, name, table.q) for name in missing)}")
    return {name: table.q[name] for name in names}


def _unknown(what: str, name: str, known: Sequence[str] | Mapping[str, object]) -> str:
    folded = {other.casefold(): other for other in known}
    near = get_close_matches(name.casefold(), list(folded), n=1)
    hint = f"did you mean {folded[near[0]]!r}? " if near else ""
    return f"no {what} {name!r}; {hint}there are: {', '.join(known) or 'none'}"


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
    turned = {name: track_cluster(track, cluster).q for name, cluster in static.clusters.items()}
    return np.asarray(track.t_ns / 1e9), turned


def _refuse_too_little(
    trial: OfflineTrial, t_s: Array, sensors: Path, reference: Path | None
) -> None:
    for segment, q in trial.reference.items():
        seen = int(np.isfinite(q).all(axis=1).sum())
        if seen < FEWEST:
            raise Unusable(
                f"{sensors}: {segment} has {seen} instants in common with its reference "
                f"{reference or sensors}, at least {FEWEST} are needed: sensors "
                f"{trial.t_s[0]:.2f} to {trial.t_s[-1]:.2f} s, reference {t_s[0]:.2f} to "
                f"{t_s[-1]:.2f} s; do both clocks begin at the same instant?"
            )
