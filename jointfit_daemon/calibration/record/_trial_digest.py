"""Digest of the names, time stamps and values in the trials of a calibration."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.calibration._trial import CalibrationTrial


def trials_digest(*trials: CalibrationTrial | None) -> str:
    """Return the SHA-256, in hex, of the arrays of all trials and the names of their columns.

    Bytes are little-endian in a fixed order, so the digest is the same on every machine and does
    not depend on the order of the sensors in the recording.
    """
    sha = hashlib.sha256()
    for trial in trials:
        sha.update(b"trial;")
        if trial is None:
            continue
        for name in sorted(trial.sensors):
            _add(sha, name, trial.sensors[name].t_ns, trial.sensors[name].q_world_sensor)
        if (optical := trial.optical) is not None:
            names = "\n".join((*optical.markers, "", *optical.bodies))
            _add(sha, names, optical.t_ns, optical.positions)
            _add(sha, "bodies", optical.body_positions, optical.body_orientations)
            if optical.residuals is not None:
                _add(sha, "residuals", optical.residuals)
    return sha.hexdigest()


def _add(sha: hashlib._Hash, name: str, *arrays: NDArray[np.int64] | NDArray[np.float64]) -> None:
    for array in arrays:
        little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
        sha.update(f"{name};{little.shape};".encode())
        sha.update(little.tobytes())
