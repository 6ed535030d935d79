"""Orientations interpolated to other instants. Long gaps are not bridged and result in NaN."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import visible

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration._trial import SensorTrack


MAX_GAP_SAMPLES = 3.5
"""Widest interpolated gap, in median sample periods. Two missing samples are bridged, but not
three.
"""


def orientations_at(t_ns: NDArray[np.int64], q: Array, at_ns: NDArray[np.int64]) -> Array:
    """Interpolate orientations along the shortest rotation, q_i exp(a log(q_i* q_i+1)).

    Parameters
    ----------
    t_ns : ndarray, shape (n,)
        Instants, strictly increasing, ns.
    q : ndarray, shape (n, 4)
        Unit quaternions; rows with NaN are ignored.
    at_ns : ndarray, shape (m,)
        Target instants, ns.

    Returns
    -------
    ndarray, shape (m, 4)
        Orientations; NaN outside the track and inside gaps.
    """
    good = visible(q)
    t, q = t_ns[good], q[good]
    if len(t) < 2:
        return np.full((len(at_ns), 4), np.nan)

    widest = MAX_GAP_SAMPLES * float(np.median(np.diff(t_ns)))
    i = np.clip(np.searchsorted(t, at_ns, side="right") - 1, 0, len(t) - 2)
    width = (t[i + 1] - t[i]).astype(np.float64)
    share = (at_ns - t[i]) / width

    out = rotation.interpolate(q[i], q[i + 1], share)
    out[(share < 0.0) | (share > 1.0) | ((width > widest) & (share > 0.0) & (share < 1.0))] = np.nan
    return out


def sensor_at(track: SensorTrack, at_ns: NDArray[np.int64], lag_ns: int = 0) -> Array:
    """Return the orientations of a sensor at instants of the optical clock.

    `lag_ns` is the sensor time stamp minus the optical time stamp of the same event, so the sensor
    is evaluated at ``at_ns + lag_ns``.
    """
    return orientations_at(track.t_ns, track.q_world_sensor, at_ns + lag_ns)
