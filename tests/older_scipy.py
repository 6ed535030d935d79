"""Rotations of scipy 1.15 for tests that run with an older scipy, such as that of Debian 12.

Pytest loads this module with ``-p tests.older_scipy``, before any test imports scipy. It replaces
`scipy.spatial.transform.Rotation` by a subclass that has the newer arguments.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
import scipy.spatial.transform
from typing_extensions import override  # typing has it from Python 3.12

_NEW_ARGUMENTS = (1, 15)


class _Rotation(scipy.spatial.transform.Rotation):
    @classmethod
    @override
    def from_quat(cls, quat: Any, *, scalar_first: bool = False) -> Self:
        quat = np.roll(quat, -1, axis=-1) if scalar_first else quat
        return super().from_quat(quat)  # type: ignore[return-value]  # of this class in scipy 1.10

    @classmethod
    @override
    def random(  # type: ignore[override]
        cls, num: Any = None, rng: Any = None, *, random_state: Any = None
    ) -> Any:
        return super().random(num, random_state=rng if random_state is None else random_state)

    @override
    def as_quat(self, canonical: bool = False, *, scalar_first: bool = False) -> Any:
        q = super().as_quat()
        if canonical:
            raise NotImplementedError("scipy 1.10 has no canonical quaternions")
        return np.roll(q, 1, axis=-1) if scalar_first else q

    @override
    def __pow__(self, n: Any, modulus: None = None) -> Any:
        return self.from_rotvec(n * self.as_rotvec())


if tuple(map(int, scipy.__version__.split(".")[:2])) < _NEW_ARGUMENTS:
    scipy.spatial.transform.Rotation = _Rotation  # type: ignore[misc, assignment]
