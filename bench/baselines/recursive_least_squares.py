# ruff: noqa: N806 - matrices have capital names
r"""Recursive least squares with forgetting, compared with its batch form.

The cost of an update does not depend on the number of samples. With a forgetting factor of 1, the
result equals the batch fit. A factor of :math:`\mu = e^{-\Delta t/\tau}`, with the sample period
:math:`\Delta t`, averages over about tau seconds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array

EXCITATION = 1e-3
"""Threshold of the excitation g^T P g (see `RecursiveLeastSquares`). A sample below it contains
almost no new information, and its update with forgetting would only increase P.
"""
IDLE_SAMPLES = 100
"""Number of successive samples below `EXCITATION` of which one is used in any case. At 100 Hz,
about one sample per second is used."""
SYMMETRIZE_EVERY = 1000


class RecursiveLeastSquares:
    r"""Least squares by the matrix-inversion lemma.

    .. math:: K = \frac{P g}{\mu / w + g^T P g},\quad
              \Theta \leftarrow \Theta + K (y^T - g^T \Theta),\quad
              P \leftarrow (P - K g^T P) / \mu, \qquad P_0 = I / \lambda_0

    Here g are the regressors, y the targets and w the weight of a sample (see `feed`). Two measures
    prevent wind-up. Most samples without excitation are skipped, and tr P never exceeds its initial
    value.

    Parameters
    ----------
    regressors, targets : int
        Number p of regressors, and number m of targets. Theta has the shape (p, m).
    ridge : float
        lambda_0, the weight of the prior Theta = 0.
    forgetting : float
        mu in (0, 1]. With 1, there is no forgetting, and no sample is skipped.
    """

    def __init__(
        self, regressors: int, targets: int, ridge: float, forgetting: float = 1.0
    ) -> None:
        if not 0.0 < forgetting <= 1.0:
            raise ValueError(f"forgetting {forgetting} is not in (0, 1]")
        self.coefficients: Array = np.zeros((regressors, targets))
        self._P: Array = np.eye(regressors) / ridge
        self._largest_trace = regressors / ridge
        self._forgetting = forgetting
        self._samples = self._passed_over = 0

    def feed(self, g: ArrayLike, y: ArrayLike, weight: float = 1.0) -> bool:
        """Add regressors g (p,) and target y (m,); return False if the sample was skipped."""
        g = np.asarray(g, dtype=np.float64)
        Pg = self._P @ g
        excitation = float(g @ Pg)
        if self._forgetting < 1.0 and excitation <= EXCITATION:
            self._passed_over += 1
            if self._passed_over < IDLE_SAMPLES:
                return False
        self._passed_over = 0
        K = Pg / (self._forgetting / weight + excitation)
        self.coefficients = self.coefficients + np.outer(K, np.asarray(y) - g @ self.coefficients)
        self._P = (self._P - np.outer(K, Pg)) / self._forgetting
        self._keep_sound()
        return True

    def _keep_sound(self) -> None:
        self._samples += 1
        trace = float(np.trace(self._P))
        if trace > self._largest_trace:
            self._P *= self._largest_trace / trace
        if self._samples % SYMMETRIZE_EVERY == 0:
            self._P = 0.5 * (self._P + self._P.T)


class InformationForm:
    r"""Least squares from accumulated sums; the coefficients are computed on demand.

    .. math:: A \leftarrow \mu A + w g g^T,\quad B \leftarrow \mu B + w g y^T,\quad
              \Theta = A^{-1} B, \qquad A_0 = \lambda_0 I

    Symbols and parameters are those of `RecursiveLeastSquares`.
    """

    def __init__(
        self, regressors: int, targets: int, ridge: float, forgetting: float = 1.0
    ) -> None:
        self._A: Array = ridge * np.eye(regressors)
        self._B: Array = np.zeros((regressors, targets))
        self._forgetting = forgetting

    def feed(self, g: ArrayLike, y: ArrayLike, weight: float = 1.0) -> None:
        """Add regressors g (p,) and target y (m,)."""
        g = np.asarray(g, dtype=np.float64)
        self._A = self._forgetting * self._A + weight * np.outer(g, g)
        self._B = self._forgetting * self._B + weight * np.outer(g, np.asarray(y))

    @property
    def coefficients(self) -> Array:
        """Coefficients Theta, shape (p, m)."""
        return np.asarray(np.linalg.solve(self._A, self._B), dtype=np.float64)
