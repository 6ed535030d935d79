"""Settings and data packets of a simulated QTM server.

Input poses are in a world with z up, in m. Packets have the axes of the server, in mm.

Invariant: all labeled markers and bodies are sent, in the order of the settings. If a marker or
body is missing, all bits of its position and rotation are set.
"""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING
from xml.sax.saxutils import escape, quoteattr

from jointfit_daemon.units import MM_PER_M
from jointfit_protocols.qtm import (
    ComponentType,
    ItemsComponent,
    QtmTimecode,
    TimecodeComponent,
    TimecodeType,
)
from jointfit_simulators.devices._rotations import rotation_rows

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from jointfit_protocols.qtm import Component
    from jointfit_simulators.devices._natnet_frames import (
        Bodies,
        Markers,
        Quaternion,
        RigidBodyAsset,
        Vector,
    )

_RESIDUAL = 0.5
"""Residual of markers and bodies, mm."""
_ABSENT: float = struct.unpack("<d", b"\xff" * 8)[0]
"""NaN whose bits are all set, even after a conversion to 32 bits."""
_NESTED_FROM = (1, 21)
"""First protocol version in which the points of bodies are XML attributes."""
_ENABLED_FROM = (1, 24)
_COMPONENTS = {
    "3d": ComponentType.MARKERS,
    "3dres": ComponentType.MARKERS_RESIDUAL,
    "3dnolabels": ComponentType.UNLABELED,
    "3dnolabelsres": ComponentType.UNLABELED_RESIDUAL,
    "6d": ComponentType.BODIES,
    "6dres": ComponentType.BODIES_RESIDUAL,
    "6deuler": ComponentType.BODIES_EULER,
    "6deulerres": ComponentType.BODIES_EULER_RESIDUAL,
    "timecode": ComponentType.TIMECODE,
}
"""Components, by their names in commands."""


def requested_components(words: Sequence[str]) -> tuple[ComponentType, ...]:
    """Return the components whose names are among the words of a command."""
    return tuple(_COMPONENTS[word] for word in words if word in _COMPONENTS)


def settings_xml(
    parts: Sequence[str],
    version: tuple[int, int],
    bodies: Sequence[RigidBodyAsset],
    *,
    rate_hz: float,
    up_axis: str,
    camera_time: bool,
    relative: Sequence[str] = (),
) -> str:
    """Return the answer to ``GetParameters`` for the parts General, 3D and 6D."""
    wanted = {part.partition(":")[0].lower() for part in parts}
    everything = "all" in wanted
    text = ""

    if everything or "general" in wanted:
        text += (
            f"<General><Frequency>{rate_hz:g}</Frequency><External_Timestamp>"
            f"<Enabled>{str(camera_time).lower()}</Enabled><Type>Camera time</Type>"
            "<Frequency>30</Frequency></External_Timestamp><RealTime_Processing_Actions>"
            "<Track6DOF>true</Track6DOF></RealTime_Processing_Actions></General>"
        )
    if everything or "3d" in wanted:
        labels = [name for body in bodies for name in body.markers]
        named = "".join(
            f"<Label><Name>{escape(name)}</Name><RGBColor>2124031</RGBColor></Label>"
            for name in labels
        )
        text += (
            f"<The_3D><AxisUpwards>+{up_axis.upper()}</AxisUpwards>"
            "<CalibrationTime>2026-01-01 12:00:00</CalibrationTime>"
            f"<Labels>{len(labels)}</Labels>{named}</The_3D>"
        )

    if everything or "6d" in wanted:
        text += _bodies_xml(version, bodies, relative)

    root = "QTM_Parameters_Ver_{}.{}".format(*version)
    return f"<{root}>{text}</{root}>"


def _bodies_xml(
    version: tuple[int, int], bodies: Sequence[RigidBodyAsset], relative: Sequence[str]
) -> str:
    described = []
    nested = version >= _NESTED_FROM
    for body in bodies:
        points = body.positions or ((0.0, 0.0, 0.0),) * len(body.markers)
        points_mm = [_numbers(point, 3) for point in points]
        text = f"<Name>{escape(body.name)}</Name>"
        if not nested:
            text += "<RGBColor>65280</RGBColor>"
            for x, y, z in points_mm:
                text += f"<Point><X>{x}</X><Y>{y}</Y><Z>{z}</Z></Point>"
            described.append(f"<Body>{text}</Body>")
            continue

        origin = 1 if body.name in relative else 0
        if version >= _ENABLED_FROM:
            text += "<Enabled>true</Enabled>"
        text += '<Color R="0" G="255" B="0"/><Mesh><Name/></Mesh><Points>'
        for number, (x, y, z) in enumerate(points_mm, 1):
            name = quoteattr(f"{body.name} - {number}")
            text += f'<Point X="{x:f}" Y="{y:f}" Z="{z:f}" Virtual="0" PhysicalId="0" Name={name}/>'
        text += (
            f'</Points><Data_origin X="0" Y="0" Z="0" Relative_body="1">{origin}</Data_origin>'
            f'<Data_orientation R11="1" Relative_body="1">{origin}</Data_orientation>'
        )
        described.append(f"<Body>{text}</Body>")
    if nested:
        return f"<The_6D>{''.join(described)}</The_6D>"
    euler = "<Euler><First>Roll</First><Second>Pitch</Second><Third>Yaw</Third></Euler>"
    return f"<The_6D><Bodies>{len(bodies)}</Bodies>{''.join(described)}{euler}</The_6D>"


def components(
    kinds: Sequence[ComponentType],
    markers: Markers,
    bodies: Bodies,
    *,
    assets: Sequence[RigidBodyAsset],
    axes: tuple[Callable[..., Vector], Callable[..., Quaternion]],
    camera_ticks: int | None,
) -> list[Component]:
    """Return the requested components of one frame.

    Parameters
    ----------
    kinds : sequence of ComponentType
        Components in the order of the request.
    markers, bodies : mapping
        Poses in the world (z up), m; None if not visible.
    assets : sequence of RigidBodyAsset
        Bodies and their markers in the settings.
    axes : pair of callable
        Conversion of positions and orientations to the server's axes.
    camera_ticks : int, optional
        Exposure time on the camera clock, in units of 100 ns; None without camera time.
    """
    place, turn = axes
    found: list[Component] = []
    labels = [name for asset in assets for name in asset.markers]

    for kind in kinds:
        if kind == ComponentType.TIMECODE:
            codes = () if camera_ticks is None else (_camera_code(camera_ticks),)
            found.append(TimecodeComponent(codes))
        elif kind in (ComponentType.MARKERS, ComponentType.MARKERS_RESIDUAL):
            with_residual = kind == ComponentType.MARKERS_RESIDUAL
            items = tuple(
                _numbers(None if (at := markers.get(name)) is None else place(*at), 3)
                + (_RESIDUAL,) * with_residual
                for name in labels
            )
            found.append(ItemsComponent(kind, 0, 0, items))

        # An unlabeled marker has a number instead of a name.
        elif kind in (ComponentType.UNLABELED, ComponentType.UNLABELED_RESIDUAL):
            with_residual = kind == ComponentType.UNLABELED_RESIDUAL
            loose = [
                (number, place(*at))
                for number, (name, at) in enumerate(markers.items(), 1)
                if at is not None and name not in labels
            ]
            items = tuple(
                (*_numbers(at, 3), number, *(_RESIDUAL,) * with_residual) for number, at in loose
            )
            found.append(ItemsComponent(kind, 0, 0, items))
        else:
            items = tuple(
                _body(kind, None if pose is None else (place(*pose[0]), turn(*pose[1])))
                for pose in (bodies.get(asset.name) for asset in assets)
            )
            found.append(ItemsComponent(kind, 0, 0, items))
    return found


def _camera_code(ticks: int) -> QtmTimecode:
    return QtmTimecode(TimecodeType.CAMERA, ticks >> 32 & 0xFFFFFFFF, ticks & 0xFFFFFFFF)


def _numbers(position: Vector | None, width: int) -> tuple[float, ...]:
    if position is None:
        return (_ABSENT,) * width
    return tuple(value * MM_PER_M for value in position)


def _body(kind: ComponentType, pose: tuple[Vector, Quaternion] | None) -> tuple[float, ...]:
    """Return position, rotation and residual of a body in the format of the component."""
    euler = kind in (ComponentType.BODIES_EULER, ComponentType.BODIES_EULER_RESIDUAL)
    residual = kind in (ComponentType.BODIES_RESIDUAL, ComponentType.BODIES_EULER_RESIDUAL)
    last = (_RESIDUAL,) * residual
    if pose is None:
        return (*(_ABSENT,) * (6 if euler else 12), *(-1.0,) * residual)

    position, q = _numbers(pose[0], 3), pose[1]
    rows = rotation_rows(q)
    if euler:  # R = Rx Ry Rz
        (r00, r01, r02), (_, _, r12), (_, _, r22) = rows
        angles = (
            math.atan2(-r12, r22),
            math.atan2(r02, math.hypot(r00, r01)),
            math.atan2(-r01, r00),
        )
        return (*position, *map(math.degrees, angles), *last)
    column_major = tuple(row[column] for column in range(3) for row in rows)
    return (*position, *column_major, *last)
