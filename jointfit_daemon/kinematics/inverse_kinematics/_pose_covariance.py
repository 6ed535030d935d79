r"""Covariance of poses from inverse kinematics, and the degrees of freedom without information.

Let J be the derivative of the marker positions with respect to a step, and W the weights. The
covariance of a step is

.. math:: C_t = s^2 (J_t^T W_t J_t)^{-1}, \qquad
          s^2 = \frac{\sum_{tm} w_{tm} |e_{tm}|^2}{\sum_t (3 n_t - n_q)}

where :math:`n_t` is the number of markers at instant t, :math:`n_q` the number of degrees of
freedom, and e are the marker errors. The covariance assumes independent marker errors. Errors of
the model (scale, joint centers) are not included.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics.chains import jacobian
from jointfit_daemon.kinematics.inverse_kinematics._solver import OPEN_M2

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chains import ChainModel
    from jointfit_daemon.kinematics.inverse_kinematics._solver import IkResult

_RIDGE = 1e-9
"""Information, m^2/rad^2, that is added to make the matrix of undetermined instants invertible."""
_TOGETHER = 500
"""Number of instants that are computed at once, which limits the memory."""


def pose_covariance(model: ChainModel, found: IkResult) -> tuple[Array, NDArray[np.bool_]]:
    """Return the covariance of every pose, and the degrees of freedom that the markers determine.

    Returns
    -------
    covariance
        Covariance of the step from the true state to the estimate, rad^2 and m^2, shape (T, nq,
        nq).
    determined
        Mask, shape (T, nq). It is False if the information about a degree of freedom, while all
        other degrees of freedom are free, is less than the information of one marker that is 2 cm
        from the axis of this degree of freedom.
    """
    w = found.weights
    seen = np.where(np.isfinite(found.residuals).all(axis=-1), w, 0.0) > 0.0
    square = np.where(seen, np.einsum("tmi,tmi->tm", found.residuals, found.residuals), 0.0)
    freedom = np.maximum(3 * seen.sum(axis=1) - model.nq, 0).sum()
    variance = float((w * square).sum() / max(freedom, 1))
    typical = float(np.median(w[seen])) if seen.any() else 1.0

    covariance = np.empty((len(w), model.nq, model.nq))
    for first in range(0, len(w), _TOGETHER):
        part = slice(first, first + _TOGETHER)
        J = jacobian(model, found.state.take(part)).reshape(len(w[part]), -1, model.nq)
        weighted = J * np.repeat(np.where(seen, w, 0.0)[part], 3, axis=1)[..., None]
        H = weighted.swapaxes(-1, -2) @ J + _RIDGE * typical * np.eye(model.nq)
        covariance[part] = np.linalg.inv(H)

    information = 1.0 / np.einsum("tkk->tk", covariance)
    return variance * covariance, np.asarray(information >= OPEN_M2 * typical)
