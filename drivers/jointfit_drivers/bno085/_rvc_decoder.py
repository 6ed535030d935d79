r"""Decoder of the mode UART-RVC: converts Euler angles to samples with quaternions.

The orientation of a sample is *canonical*: a Hamilton unit quaternion, scalar first, from the
sensor to a world with x east, y north and z up (`jointfit_protocols.orientation`).

According to the data sheet, yaw, pitch and roll are successive rotations about z, y and x
(``zyx``). The example message of the data sheet contradicts this order. It contains pitch -1.10 and
roll 20.85 degrees with accelerations of -371, -20 and 977 mg. With pitch about x and roll about y
(``zxy``),

.. math:: R = R_z(\text{yaw})\, R_x(\text{pitch})\, R_y(\text{roll}), \qquad
    R^T e_z = (-0.356, -0.019, 0.934),

where e_z is the unit vector upwards. This direction agrees with the direction of the measured
acceleration, (-0.355, -0.019, 0.935). With ``zyx`` the direction is (0.019, 0.356, 0.934). The
default is therefore ``zxy``. The decoder also compares both orders with the accelerations at rest,
and warns if the order that is not configured fits better.

Invariant: the output depends only on the chunks fed; the decoder reads no clock and no port.
"""

from __future__ import annotations

from math import cos, hypot, radians, sin, sqrt
from typing import TYPE_CHECKING

from typing_extensions import override

from jointfit_daemon.model import DeviceEvent, ImuSample
from jointfit_drivers.refusals import Refusals
from jointfit_drivers.serial_decoder import SerialMessageDecoder
from jointfit_protocols.bno085 import RVC_BYTES, RvcCodec, RvcFrame
from jointfit_protocols.orientation import OrientationGate, Quaternion

if TYPE_CHECKING:
    from typing import Literal

    from jointfit_daemon.model import Decoded, Vector

_ANGLE = radians(0.01)
"""Angle of one count, rad."""
_FORCE = 9.80665e-3
"""Specific force of one count, m/s^2."""
_COUNTS = 256
_MOST_LOST = 128
"""Smallest step of the frame index, modulo 256, that counts as a decrease."""
_REST = 0.06
"""Largest relative deviation of an acceleration from 1 g at rest."""
_DISTINCT = 0.2
"""Smallest distance at which the upward unit vectors of the two axis orders are compared."""
_COMPARED = 100
"""Number of frames at rest after which the two orders of axes are compared."""
_BETTER = 3.0
"""Smallest ratio of two deviations from the measured accelerations that causes a warning: the
deviation of the configured axis order, divided by the deviation of the other order."""
_G_COUNTS = 1000.0


class RvcDecoder(SerialMessageDecoder[RvcFrame]):
    """Decoder of one device in the mode UART-RVC.

    Parameters
    ----------
    baud : int, optional
        Line speed, bit/s, from which the arrival of the first byte of a message is computed; None
        for USB.
    euler : str
        Axes of yaw, pitch and roll, ``zxy`` or ``zyx``.
    """

    tick_clock = None  # a frame has an index, but no time

    def __init__(self, baud: int | None, euler: Literal["zxy", "zyx"] = "zxy") -> None:
        super().__init__(RvcCodec(), Refusals(), baud, RVC_BYTES)
        self._euler = euler
        self._gate = OrientationGate()
        self._number: int | None = None
        self._compared = 0
        self._deviations = [0.0, 0.0]  # sums for the configured order and for the other order

    @override
    def _take(self, message: RvcFrame) -> list[Decoded]:
        out: list[Decoded] = []
        step = 1 if self._number is None else (message.number - self._number) % _COUNTS
        self._number = message.number
        if 1 < step < _MOST_LOST:
            out.append(DeviceEvent("gap", f"{step - 1} messages lost", {"lost": step - 1}))

        native = quaternion_of(message.angles, self._euler)
        q = self._gate.admit(native)
        arrival_ns = self._arrival_of(message)
        x, y, z = message.acceleration
        force = (_FORCE * x, _FORCE * y, _FORCE * z)
        if q is not None:  # always true, because `quaternion_of` returns norm 1
            out.append(ImuSample(arrival_ns, q, native, None, message.number, acceleration=force))
        if self._compared < _COMPARED:
            out += self._compare(message)
        return out

    def _compare(self, frame: RvcFrame) -> list[Decoded]:
        """Compare both axis orders with gravity at rest; warn if the unused order fits better."""
        x, y, z = frame.acceleration
        strength = sqrt(x * x + y * y + z * z) / _G_COUNTS
        if abs(strength - 1.0) > _REST:
            return []
        other: Literal["zxy", "zyx"] = "zyx" if self._euler == "zxy" else "zxy"
        ours, theirs = (gravity_of(frame.angles, order) for order in (self._euler, other))
        if _distance(ours, theirs) < _DISTINCT:
            return []

        scale = 1.0 / (strength * _G_COUNTS)
        measured = (scale * x, scale * y, scale * z)
        self._compared += 1
        self._deviations[0] += _distance(ours, measured)
        self._deviations[1] += _distance(theirs, measured)
        if self._compared < _COMPARED or self._deviations[0] < _BETTER * self._deviations[1]:
            return []
        text = f'accelerations at rest fit euler = "{other}", not "{self._euler}": set euler'
        return [DeviceEvent("warning", text, {"euler": other})]


def quaternion_of(angles: tuple[int, int, int], euler: Literal["zxy", "zyx"]) -> Quaternion:
    """Return q_world_sensor, world z up, for yaw, pitch and roll in units of 0.01 degrees."""
    (cz, sz), (cp, sp), (cr, sr) = (
        (cos(0.5 * _ANGLE * angle), sin(0.5 * _ANGLE * angle)) for angle in angles
    )
    # q = q_z ⊗ (a + b i + c j + d k); the brackets contain the product of pitch and roll.
    if euler == "zxy":
        a, b, c, d = cp * cr, sp * cr, cp * sr, sp * sr
    else:
        a, b, c, d = cp * cr, cp * sr, sp * cr, -sp * sr
    return (cz * a - sz * d, cz * b - sz * c, cz * c + sz * b, cz * d + sz * a)


def gravity_of(angles: tuple[int, int, int], euler: Literal["zxy", "zyx"]) -> Vector:
    """Return the unit vector that points upwards, in sensor axes."""
    w, x, y, z = quaternion_of(angles, euler)
    return (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z)


def _distance(a: Vector, b: Vector) -> float:
    return hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2])
