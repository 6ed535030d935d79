"""NPZ files: orientations of sensors and, if measured by a reference system, of bones.

World and segment frames are returned in the axes of the project (z up, x right, y forward),
whatever the axes of the file. A file with n instants contains these arrays::

    t        (n,)     seconds
    ID_quat  (n, 4)   orientation of sensor ID, (w, x, y, z), sensor to world
    q_BONE   (n, 4)   orientation of a bone, bone to world
    p_BONE   (n, 3)   origin of the bone, m
    up       ()       "y" or "z": the vertical axis; default y, with x forward (OpenSim)

A y-up file is converted as `jointfit_daemon.files.axes` describes: a quaternion (w, x, y, z)
becomes (w, z, x, y).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from zipfile import ZipFile

import numpy as np

from jointfit_daemon.files.axes import quaternions_to_z_up, to_z_up
from jointfit_daemon.files.text import MalformedFileError, reject_device, require_times

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path
    from zipfile import ZipInfo

    from numpy.typing import ArrayLike, NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.files.axes import Axis

_GIB = 1 << 30
LARGEST = _GIB
"""Largest uncompressed size of all arrays of a file, bytes. It corresponds to 20 hours of four
sensors at 100 Hz."""
_KINDS = "biufU"
"""Accepted kinds of NumPy arrays: Booleans, numbers, and text for ``up``."""
_SENSOR = "_quat"
_BONE, _ORIGIN = "q_", "p_"


@dataclass(frozen=True, slots=True)
class OrientationTrial:
    """Orientations of sensors and bones over time, z up."""

    t_s: NDArray[np.float64]
    """Times, s, shape (n,)."""
    sensors: Mapping[str, NDArray[np.float64]]
    """Sensor orientations q_world_sensor by id, unit quaternions, shape (n, 4); NaN where
    missing."""
    bones: Mapping[str, NDArray[np.float64]]
    """Segment orientations q_world_segment by bone, unit quaternions, shape (n, 4)."""
    origins: Mapping[str, NDArray[np.float64]]
    """Origin of each bone (the proximal joint center), m, shape (n, 3)."""


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return all arrays of an NPZ file.

    Raises
    ------
    MalformedFileError
        The file is not NPZ, is truncated, contains Python objects, or is larger than `LARGEST` when
        unpacked.
    """
    reject_device(path)
    with path.open("rb") as file:
        try:
            with ZipFile(file) as archive:
                return _arrays(path, archive)
        except MalformedFileError:
            raise
        except Exception as fault:  # zipfile and its codecs raise many types for damaged archives
            raise MalformedFileError(
                f"{path}: not an NPZ file, or cut off: export it again"
            ) from fault


def _arrays(path: Path, archive: ZipFile) -> dict[str, NDArray[Any]]:
    """Return the arrays of an archive; pickled objects are never read."""
    members = archive.infolist()
    unpacked = sum(member.file_size for member in members)
    if unpacked > LARGEST:
        raise MalformedFileError(
            f"{path}: {unpacked / _GIB:.1f} GiB when unpacked, at most {LARGEST / _GIB:g} GiB are"
            " read: split the trial"
        )
    return {
        member.filename.removesuffix(".npy"): _array(path, archive, member) for member in members
    }


def _array(path: Path, archive: ZipFile, member: ZipInfo) -> NDArray[Any]:
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, by_columns, dtype = read_header(file)
        if dtype.kind not in _KINDS:
            raise MalformedFileError(
                f"{path}: array {member.filename} holds {dtype.name} values, expected numbers:"
                " save it without Python objects"
            )

        data = file.read()
    flat = np.frombuffer(data, dtype=dtype)
    return flat.reshape(shape, order="F" if by_columns else "C").copy()


def read_orientations_npz(path: Path) -> OrientationTrial:
    """Return the trial of an NPZ file.

    Raises
    ------
    MalformedFileError
        For the reasons given at `read_arrays`; or the file has no ``t``, or neither a sensor nor a
        bone.
    """
    arrays = read_arrays(path)
    names = [name.removesuffix(_SENSOR) for name in arrays if name.endswith(_SENSOR)]
    bones = [n.removeprefix(_BONE) for n in arrays if n.startswith(_BONE)]
    if "t" not in arrays or not (names or bones):
        found = ", ".join(arrays) or "none"
        raise MalformedFileError(
            f"{path}: found the arrays {found}, expected t and at least one ID_quat or q_BONE:"
            " rename or add them"
        )
    up: Axis = "z" if "up" in arrays and str(arrays["up"]) == "z" else "y"

    def turned(name: str) -> Array:
        return quaternions_to_z_up(_numbers(path, arrays, name, (count, 4)), up)

    t_s = _numbers(path, arrays, "t", None)
    require_times(path, t_s)
    count = len(t_s)
    return OrientationTrial(
        t_s,
        {n: turned(n + _SENSOR) for n in names},
        {b: turned(_BONE + b) for b in bones},
        {
            b: to_z_up(_numbers(path, arrays, _ORIGIN + b, (count, 3)), up)
            for b in bones
            if _ORIGIN + b in arrays
        },
    )


def _numbers(
    path: Path, arrays: Mapping[str, NDArray[Any]], name: str, shape: tuple[int, int] | None
) -> NDArray[np.float64]:
    """Return an array of `shape` (None: one-dimensional) as floats, or raise an error."""
    array = arrays[name]
    if array.dtype.kind == "U":
        raise MalformedFileError(f"{path}: {name} holds text, expected numbers: save it as float64")
    if array.shape != shape and not (shape is None and array.ndim == 1):
        wanted = "(n,)" if shape is None else str(shape)
        raise MalformedFileError(
            f"{path}: {name} has shape {array.shape}, expected {wanted}: write one row for each"
            " instant of t, and NaN in gaps"
        )
    return array.astype(np.float64)


def write_orientations_npz(path: Path, trial: OrientationTrial) -> None:
    """Write a trial to a compressed file with z up."""
    arrays: dict[str, ArrayLike] = {"t": trial.t_s, "up": np.array("z")}
    arrays |= {name + _SENSOR: values for name, values in trial.sensors.items()}
    arrays |= {_BONE + bone: values for bone, values in trial.bones.items()}
    arrays |= {_ORIGIN + bone: values for bone, values in trial.origins.items()}
    np.savez_compressed(path, allow_pickle=False, **{k: np.asarray(v) for k, v in arrays.items()})
