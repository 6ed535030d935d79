"""Motion of OpenSim joints: evaluation of their functions and transforms.

Functions and transforms are evaluated as OpenSim defines them, for several coordinate values at
once, one per row.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicSpline

from jointfit_daemon.files.models._osim_document import numbers_of, text_of
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from collections.abc import Callable
    from xml.etree.ElementTree import Element

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.files.models._osim_document import OsimJoint

    Function = Callable[[Array], Array]

_X, _Y, _Z = np.eye(3)
_TURNING = 3
"""Number of rotational axes of a transform. The same number of translational axes follows them."""
_CUBIC = 4
"""Smallest number of points of a cubic spline."""
_TURNS: dict[str, list[Array]] = {
    "WeldJoint": [],
    "SliderJoint": [],
    "PinJoint": [_Z],
    "PlanarJoint": [_Z],
    "UniversalJoint": [_X, _Y],
    "BallJoint": [_X, _Y, _Z],
    "GimbalJoint": [_X, _Y, _Z],
    "FreeJoint": [_X, _Y, _Z],
}
_SHIFTS: dict[str, list[Array]] = {
    "SliderJoint": [_X],
    "PlanarJoint": [_X, _Y],
    "FreeJoint": [_X, _Y, _Z],
}


class JointMotion:
    """Transform of a joint as a function of its coordinates.

    Parameters
    ----------
    joint
        Joint as written in the file.

    Raises
    ------
    ValueError
        The type of the joint, or of one of its functions, is not supported.
    """

    def __init__(self, joint: OsimJoint) -> None:
        self.names = [c.name for c in joint.coordinates]
        if joint.kind == "CustomJoint" and joint.spatial is not None:
            axes = [_custom(axis) for axis in joint.spatial.iterfind("TransformAxis")]
        elif joint.kind in _TURNS:
            vectors = [
                *_pad_to_three(_TURNS[joint.kind]),
                *_pad_to_three(_SHIFTS.get(joint.kind, [])),
            ]
            needed = sum(vector is not None for vector in vectors)
            if len(self.names) != needed:
                raise ValueError(
                    f"joint {joint.name}: {len(self.names)} coordinates, expected {needed} for a "
                    f"{joint.kind}"
                )
            waiting = iter(self.names)
            axes = [
                ("", _X, np.zeros_like) if axis is None else (next(waiting), axis, np.asarray)
                for axis in vectors
            ]
        else:
            raise ValueError(f"joint {joint.name}: {joint.kind} is not supported")
        if len(axes) != 2 * _TURNING:
            raise ValueError(f"joint {joint.name}: {len(axes)} transform axes, expected 6")
        self._axes = axes

    @property
    def second_rotation(self) -> str:
        """Name of the coordinate of the second rotation; empty if there is none."""
        return self._axes[1][0]

    @property
    def turning(self) -> frozenset[str]:
        """Names of the coordinates that rotate the child body."""
        return self._driving_functions(self._axes[:_TURNING])

    @property
    def shifting(self) -> frozenset[str]:
        """Names of the coordinates that translate the child body."""
        return self._driving_functions(self._axes[_TURNING:])

    def _driving_functions(self, axes: list[tuple[str, Array, Function]]) -> frozenset[str]:
        probe = np.linspace(-1.0, 1.0, 7)
        return frozenset(name for name, _, f in axes if name and np.ptp(f(probe)) > 0.0)

    def at(self, values: dict[str, Array]) -> tuple[Array, Array]:
        """Return R, shape (n, 3, 3), and t, m, shape (n, 3), from child frame to parent frame.

        Parameters
        ----------
        values
            Values of each coordinate by its name, shape (n,).
        """
        count = max((len(v) for v in values.values()), default=1)
        q = np.broadcast_to(rotation.IDENTITY, (count, 4))
        t = np.zeros((count, 3))
        for i, (name, axis, function) in enumerate(self._axes):
            amount = function(values[name] if name else np.zeros(count))[:, None]
            if i < _TURNING:
                q = rotation.multiply(q, rotation.exp(amount * axis))
            else:
                t = t + amount * axis
        return rotation.to_matrix(q), t


def _pad_to_three(vectors: list[Array]) -> list[Array | None]:
    return [*vectors, *[None] * (3 - len(vectors))]


def _custom(axis: Element) -> tuple[str, Array, Function]:
    vector = numbers_of(axis, "axis", 3)
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        raise ValueError(f"{axis.get('name')}: its axis has no length")

    names = text_of(axis, "coordinates").split()
    if len(names) > 1:
        raise ValueError(f"{axis.get('name')}: a function of {len(names)} coordinates, expected 1")

    written = [child for child in axis if child.tag not in {"coordinates", "axis"}]
    if len(written) == 1 and written[0].tag == "function":
        written = list(written[0])
    function = _function(written[0]) if written else np.zeros_like
    return (names[0] if names else ""), vector / length, function


def _function(element: Element) -> Function:
    kind = element.tag
    if kind == "Constant":
        value = _scalar(element, "value", 0.0)
        return lambda q: np.full(len(q), value)
    if kind == "MultiplierFunction":
        scale = _scalar(element, "scale", 1.0)
        inner = element.find("function/*")
        if inner is None:
            raise ValueError("a MultiplierFunction without a function")
        scaled = _function(inner)
        return lambda q: scale * scaled(q)
    if kind in {"LinearFunction", "PolynomialFunction"}:
        coefficients = numbers_of(element, "coefficients")
        return lambda q: np.asarray(np.polyval(coefficients, q))

    if kind in {"SimmSpline", "NaturalCubicSpline", "PiecewiseLinearFunction"}:
        return _through_points(element)
    raise ValueError(f"function {kind} is not supported")


def _scalar(element: Element, tag: str, default: float) -> float:
    return default if element.find(tag) is None else float(numbers_of(element, tag, 1)[0])


def _through_points(element: Element) -> Function:
    """Return a curve through points, extrapolated linearly.

    In OpenSim, the first and the last piece of a SimmSpline follow the cubic through the four
    nearest points. Here, each of them continues the cubic of the adjacent piece. The difference is
    a few micrometres in these pieces. OpenSim evaluates a NaturalCubicSpline as a SimmSpline, and
    so does this function.
    """
    x, y = numbers_of(element, "x"), numbers_of(element, "y")
    if x.size != y.size or x.size <= 1 or not (np.diff(x) > 0.0).all():
        raise ValueError(f"{element.tag}: its x values must increase, and each needs one y value")
    if element.tag == "PiecewiseLinearFunction" or x.size < _CUBIC:
        return lambda q: np.asarray(np.interp(q, x, y))
    spline = CubicSpline(x, y)
    slope = spline.derivative()

    def curve(q: Array) -> Array:
        inside = np.clip(q, x[0], x[-1])
        return np.asarray(spline(inside) + slope(inside) * (q - inside))

    return curve
