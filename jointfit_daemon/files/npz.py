"""NPZ, trials as arrays: orientations of sensors, and of bones where a reference knew them.

Law: handed over in the project's world (z up, x right, y forward) with segment frames likewise,
whatever axes the file has. Arrays of a file, n instants::

    t        (n,)     seconds
    ID_quat  (n, 4)   orientation of sensor ID, (w, x, y, z), sensor to world
    q_BONE   (n, 4)   orientation of a bone, bone to world
    p_BONE   (n, 3)   its origin, m
    up       ()       "y" or "z": the file's upward axis; left out it is y, with x forward (OpenSim)

A y-up file is turned by the cyclic renaming of OpenSim's axes (x forward, y up, z right): a vector
(x, y, z) becomes (z, x, y), a quaternion (w, x, y, z) becomes (w, z, x, y). That renames the
segments' axes too, which are named like the world's.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from tokenize import TokenError
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile

import numpy as np

from jointfit_daemon.files.text_table import Malformed

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import ArrayLike, NDArray

_SENSOR = "_quat"
_BONE, _ORIGIN = "q_", "p_"
_KINDS = "biufUS"
"""Kinds of array elements that are read: booleans, integers, floats and text."""
_FAULTS = (
    BadZipFile, zlib.error, EOFError, ValueError, AttributeError, KeyError, TypeError, SyntaxError,
    MemoryError, OverflowError, RuntimeError, SystemError, TokenError,
)  # fmt: skip
"""What zipfile and numpy raise on damaged archives; NotImplementedError is a RuntimeError."""


@dataclass(frozen=True, slots=True)
class OrientationTrial:
    """Sensors and bones over time, z up."""

    t_s: NDArray[np.float64]
    """Shape (n,), s."""
    sensors: Mapping[str, NDArray[np.float64]]
    """q_world_sensor by id, shape (n, 4), unit; NaN where missing."""
    bones: Mapping[str, NDArray[np.float64]]
    """q_world_segment by bone, shape (n, 4), unit."""
    origins: Mapping[str, NDArray[np.float64]]
    """Origin of each bone (its proximal joint center), m, shape (n, 3)."""


def vectors_z_up(vectors: ArrayLike) -> NDArray[np.float64]:
    """Return vectors (x, y, z) of OpenSim's axes as (z, x, y), shape (..., 3)."""
    return np.asarray(vectors, dtype=np.float64)[..., [2, 0, 1]]


def quaternions_z_up(quaternions: ArrayLike) -> NDArray[np.float64]:
    """Return quaternions (w, x, y, z) of OpenSim's axes as (w, z, x, y), unit, shape (..., 4)."""
    turned = np.asarray(quaternions, dtype=np.float64)[..., [0, 3, 1, 2]]
    return _unit(turned)


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return all arrays of an NPZ file.

    Raises
    ------
    Malformed
        It is none, is cut off, or holds what only Python could read.
    """
    try:
        # numpy leaves a file open that it opened itself and cannot read
        with path.open("rb") as file, np.load(file, allow_pickle=False) as found:
            arrays: dict[str, Any] = {name: found[name] for name in found.files}
    except _FAULTS as fault:
        raise Malformed(f"{path}: not an NPZ file, or cut off: {fault}") from fault
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray) or array.dtype.kind not in _KINDS:
            found_type = getattr(array, "dtype", "no array")
            raise Malformed(f"{path}: {name} holds {found_type}, expected numbers or text")
    return arrays


def read_orientations_npz(path: Path) -> OrientationTrial:
    """Return the trial of an NPZ file.

    Raises
    ------
    Malformed
        As `read_arrays`; no ``t``, or neither a sensor nor a bone.
    """
    arrays = read_arrays(path)
    names = [name.removesuffix(_SENSOR) for name in arrays if name.endswith(_SENSOR)]
    bones = [n.removeprefix(_BONE) for n in arrays if n.startswith(_BONE)]
    if "t" not in arrays or not (names or bones):
        raise Malformed(
            f"{path}: expected arrays t and ID_quat or q_BONE, found {', '.join(arrays)}"
        )
    try:
        z_up = "up" in arrays and str(arrays["up"]) == "z"
    except SystemError as fault:  # code points beyond Unicode
        raise Malformed(f"{path}: array up: {fault}") from fault
    for name in (*(n + _SENSOR for n in names), *(_BONE + bone for bone in bones)):
        if arrays[name].shape[-1:] != (4,):
            raise Malformed(f"{path}: {name} has shape {arrays[name].shape}, expected (n, 4)")
    turn = _unit if z_up else quaternions_z_up
    move = _plain if z_up else vectors_z_up
    return OrientationTrial(
        np.asarray(arrays["t"], dtype=np.float64),
        {name: turn(arrays[name + _SENSOR]) for name in names},
        {bone: turn(arrays[_BONE + bone]) for bone in bones},
        {bone: move(arrays[_ORIGIN + bone]) for bone in bones if _ORIGIN + bone in arrays},
    )


def _unit(quaternions: ArrayLike) -> NDArray[np.float64]:
    found = np.asarray(quaternions, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):  # what is no rotation is missing
        norms = np.linalg.norm(found, axis=-1, keepdims=True)
        usable = (norms > 0.0) & np.isfinite(norms)  # 0 0 0 0: missing
        unit: NDArray[np.float64] = found / np.where(usable, norms, np.nan)
    return unit


def _plain(vectors: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(vectors, dtype=np.float64)


def write_orientations_npz(path: Path, trial: OrientationTrial) -> None:
    """Write a trial, z up, compressed."""
    arrays: dict[str, ArrayLike] = {"t": trial.t_s, "up": np.array("z")}
    arrays |= {name + _SENSOR: values for name, values in trial.sensors.items()}
    arrays |= {_BONE + bone: values for bone, values in trial.bones.items()}
    arrays |= {_ORIGIN + bone: values for bone, values in trial.origins.items()}
    np.savez_compressed(path, allow_pickle=False, **{k: np.asarray(v) for k, v in arrays.items()})
