r"""Bias, scale factors and non-orthogonality of an accelerometer from static poses.

At rest an accelerometer measures gravity, whose magnitude is the same in every pose:

.. math:: |M (f_i - b)| = g

where f_i is the measured specific force in pose i, b the bias, M the matrix of inverse scale
factors and non-orthogonality, and g the standard acceleration of gravity. An error of g is common
to all axes and does not change inclinations. Nine poses determine the six parameters of bias and
scale factors, with three degrees of freedom left. Twelve poses also determine the
non-orthogonality. The faces of the housing need not be exactly perpendicular, because only
magnitudes are used.

Source: Frosio, Pedersini and Borghese 2009, IEEE Trans. Instrum. Meas. 58, 2034-2041; the detection
of static poses is from Tedaldi, Pretto and Menegatti 2014, ICRA, 3042-3049.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from math import cos, radians
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.inertial_sensor._directions import (
    FACES,
    NAMES,
    nearest_direction,
)
from jointfit_daemon.calibration.inertial_sensor._ellipsoid_fit import (
    DIAGONAL,
    SYMMETRIC,
    fit_unit_ellipsoid,
    matrix_sd,
)
from jointfit_daemon.calibration.inertial_sensor._gyroscope_scale import fit_gyroscope_scale
from jointfit_daemon.calibration.inertial_sensor._refusal import SensorCalibrationError
from jointfit_daemon.calibration.inertial_sensor._rest_blocks import RestBlocks
from jointfit_daemon.calibration.inertial_sensor._step_progress import StepProgress
from jointfit_daemon.calibration.inertial_sensor._turns import TurnCollector
from jointfit_daemon.units import STANDARD_GRAVITY

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.inertial_sensor._gyroscope_scale import (
        GyroscopeScaleEstimate,
    )
    from jointfit_daemon.calibration.inertial_sensor._rest_blocks import SensorReading

POSES = 12
"""Number of poses of a complete step: six faces and six edges or corners."""
FEWEST_POSES = 9
"""Fewest poses of a fit, three more than its six parameters."""
FEWEST_SKEWED = 12
"""Fewest poses of a fit that includes the non-orthogonality."""
LARGEST_SKEW_SD = 0.003
"""Largest standard deviation of any off-diagonal element, rad, with which these elements are used.
"""
LARGEST_RESIDUAL = 0.1
"""Largest RMS of the corrected magnitudes minus g, m/s^2."""
LARGEST_BIAS = 3.0
"""Largest plausible bias, m/s^2."""
LARGEST_SCALE_ERROR = 0.2
"""Largest plausible error of a scale factor."""
_POSE_BLOCKS = 4
"""Number of blocks in a pose: 1 s."""
_DISTINCT = cos(radians(20.0))
"""Cosine of the smallest angle between two poses."""
_PLANES = {"x and y": (0, 1), "x and z": (0, 2), "y and z": (1, 2)}
_TILTED = 0.4
"""Smallest component of gravity along each of the two axes of a tilted pose, as a fraction of
gravity.
"""
_SATURATED = 0.5 * STANDARD_GRAVITY
"""Specific force, m/s^2, that every accelerometer measures without saturation."""


@dataclass(frozen=True, slots=True)
class AccelerometerEstimate:
    """Parameters of an accelerometer.

    If f is a measured specific force, `matrix` (f - `bias`) is the corrected specific force.
    """

    bias: Array
    """Bias, m/s^2, shape (3,)."""
    matrix: Array
    """Inverse scale factors and non-orthogonality, symmetric, shape (3, 3)."""
    bias_sd: Array
    """Standard deviations of the bias, m/s^2, shape (3,)."""
    matrix_sd: Array
    """Standard deviations of the elements of `matrix`, shape (3, 3); NaN where an element is not
    estimated.
    """
    covariance: Array
    """Covariance of the bias (m/s^2), the diagonal of `matrix` and, if estimated, its upper
    off-diagonal elements, shape (6, 6) or (9, 9).
    """
    degrees_of_freedom: int
    """Number of poses minus number of parameters."""
    poses: int
    spread_before: float
    """RMS of the uncorrected magnitudes minus g, m/s^2."""
    residual: float
    """RMS of the corrected magnitudes minus g, m/s^2."""

    def correct(self, force: Array) -> Array:
        """Return a corrected specific force, m/s^2, shape (3,)."""
        return np.asarray(self.matrix @ (force - self.bias))


def fit_accelerometer(forces: Array) -> AccelerometerEstimate:
    """Estimate the parameters from the mean specific forces of static poses.

    Parameters
    ----------
    forces
        Specific force of one pose per row, m/s^2, shape (n, 3).

    Raises
    ------
    SensorCalibrationError
        There are too few poses, or the parameters are not plausible.
    """
    if len(forces) < FEWEST_POSES:
        raise SensorCalibrationError(
            f"{len(forces)} static poses, expected at least {FEWEST_POSES} that differ by 20 "
            "degrees: repeat, and let the sensor lie still for two seconds in each pose"
        )

    # the off-diagonal elements are used only if the poses determine these elements
    unit = forces / STANDARD_GRAVITY
    fit = fit_unit_ellipsoid(unit, DIAGONAL)
    if len(forces) >= FEWEST_SKEWED:
        with suppress(SensorCalibrationError):  # raised without tilted poses
            skewed = fit_unit_ellipsoid(unit, SYMMETRIC)
            if np.sqrt(np.diag(skewed.covariance)[6:]).max() < LARGEST_SKEW_SD:
                fit = skewed

    units = np.ones(len(fit.covariance))
    units[:3] = STANDARD_GRAVITY
    covariance = fit.covariance * np.outer(units, units)
    deviations = np.sqrt(np.diag(covariance))
    estimate = AccelerometerEstimate(
        bias=fit.bias * STANDARD_GRAVITY,
        matrix=fit.matrix,
        bias_sd=deviations[:3],
        matrix_sd=matrix_sd(deviations[3:]),
        covariance=covariance,
        degrees_of_freedom=fit.degrees_of_freedom,
        poses=len(forces),
        spread_before=_rms(np.linalg.norm(forces, axis=1) - STANDARD_GRAVITY),
        residual=_rms(fit.residuals * STANDARD_GRAVITY),
    )
    _check(estimate)
    return estimate


def _check(estimate: AccelerometerEstimate) -> None:
    """Reject parameters that no real accelerometer has."""
    if estimate.residual > LARGEST_RESIDUAL:
        raise SensorCalibrationError(
            f"after the correction |a| differs from gravity by {estimate.residual:.3f} m/s² (RMS), "
            f"expected less than {LARGEST_RESIDUAL:g}: the sensor moved or was touched in a pose. "
            "Repeat, and let go of it in each pose"
        )
    bias, scale = np.abs(estimate.bias).max(), np.abs(np.diag(estimate.matrix) - 1.0).max()
    if bias > LARGEST_BIAS or scale > LARGEST_SCALE_ERROR:
        raise SensorCalibrationError(
            f"bias {bias:.2f} m/s² and scale error {100 * scale:.0f} %: expected at most "
            f"{LARGEST_BIAS:g} m/s² and {100 * LARGEST_SCALE_ERROR:.0f} %. Check the unit and the "
            "range of the acceleration in rig.toml, or replace the sensor"
        )


class AccelerometerStep:
    """Collects static poses, and estimates the parameters."""

    def __init__(self) -> None:
        self._blocks = RestBlocks()
        self._turns = TurnCollector()
        self._forces: list[Array] = []
        self._constant: list[Array] = []

    @property
    def is_complete(self) -> bool:
        """Whether all faces and enough tilted poses are collected."""
        return len(self._forces) >= POSES and not self._missing_faces() and not self._tilts()

    @property
    def progress(self) -> StepProgress:
        """Fraction of the poses that are collected, and the missing poses."""
        faces, tilts = self._missing_faces(), self._tilts()
        missing = [f"{NAMES[face]} up" for face in faces]
        missing += [f"{count} tilted between {plane}" for plane, count in tilts.items()]
        wanted = len(faces) + sum(tilts.values())
        if others := max(POSES - len(self._forces) - wanted, 0):
            missing.append(f"{others} more on edges or corners")
        return StepProgress(max(1.0 - (wanted + others) / POSES, 0.0), tuple(missing))

    def add(self, reading: SensorReading) -> None:
        """Add a reading; a pose is collected if it differs from the poses before."""
        blocks = self._blocks
        is_block = blocks.add(reading)
        self._turns.add(reading, blocks.rest if is_block else None)
        if not is_block or len(blocks.rest) <= _POSE_BLOCKS:
            return

        # the first block may contain the end of a movement
        rest = blocks.rest[1 : _POSE_BLOCKS + 1]
        force = np.mean([block.force for block in rest], axis=0)
        unit = force / np.linalg.norm(force)
        known = [float(unit @ other) / float(np.linalg.norm(other)) for other in self._forces]
        if not known or max(known) < _DISTINCT:
            self._forces.append(force)
            self._constant.append(np.all([block.constant for block in rest], axis=0))

    def finish(self) -> AccelerometerEstimate:
        """Return the parameters.

        Raises
        ------
        SensorCalibrationError
            There are too few poses, readings are saturated, or the parameters are not plausible.
        """
        missing = self._missing_faces()
        if len(self._forces) < FEWEST_POSES or len(missing) > 1:
            raise SensorCalibrationError(
                f"{len(self._forces)} static poses, expected at least {FEWEST_POSES} and five of "
                f"the six faces; missing: {', '.join(self.progress.missing)}. Repeat, and let the "
                "sensor lie still for two seconds in each pose"
            )

        # At the end of its range a saturated reading is constant, without noise.
        forces, constant = np.array(self._forces), np.array(self._constant)
        for axis, name in enumerate("xyz"):
            for end in (forces[:, axis].max(), forces[:, axis].min()):
                at_end = (forces[:, axis] == end) & constant[:, axis]
                if at_end.sum() > 1 and abs(end) > _SATURATED:
                    raise SensorCalibrationError(
                        f"the acceleration along {name} is {end:.3f} m/s² in {at_end.sum()} "
                        "different poses: it is saturated. Set a larger range of the "
                        "accelerometer in the device, and repeat"
                    )
        return fit_accelerometer(forces)

    def finish_gyroscope_scale(self, estimate: AccelerometerEstimate) -> GyroscopeScaleEstimate:
        """Return the scale factors of the gyroscope, from the turns between the poses.

        Raises
        ------
        SensorCalibrationError
            The turns do not determine the scale factors.
        """
        return fit_gyroscope_scale(self._turns.turns, estimate.correct)

    def _missing_faces(self) -> list[int]:
        taken = set(nearest_direction(np.array(self._forces)).tolist()) if self._forces else set()
        return [face for face in range(FACES) if face not in taken]

    def _tilts(self) -> dict[str, int]:
        """Return the number of missing tilted poses by pair of axes.

        The tilted poses determine the non-orthogonality.
        """
        units = np.abs(np.array([force / np.linalg.norm(force) for force in self._forces]))
        found = dict.fromkeys(_PLANES, 0)
        for unit in units:
            for name, (one, other) in _PLANES.items():
                found[name] += min(unit[one], unit[other]) > _TILTED
        return {name: 2 - count for name, count in found.items() if count < 2}


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
