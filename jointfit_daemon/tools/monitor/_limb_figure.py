"""Stick figure of the limb: the joints of a pose from the side, on a canvas of dots."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.cells import cell_len

from jointfit_daemon.tools.monitor._dot_canvas import DotCanvas, render
from jointfit_daemon.tools.monitor._rig_view import known_vector
from jointfit_daemon.tools.monitor._text_lines import Line, fit_text
from jointfit_daemon.tools.monitor._words import title_of

if TYPE_CHECKING:
    from jointfit_daemon.outputs.payload_models import Info, OpticalPose, Pose
    from jointfit_daemon.tools.monitor._rig_view import RigView

_Dot = tuple[int, int]
_LEAST_REACH_M = 0.2
"""Smallest size of the drawn region, m."""
_BRANCHED_TURN_DEG = 35.0
"""Angle between the direction of view and the lateral direction for a limb with two sides, degrees.
In a lateral view, one side would hide the other."""
_LEAST_HORIZONTAL = 0.1
"""Smallest horizontal component of the unit vector ahead of the subject. A vector with a smaller
horizontal component does not determine the direction."""
_LONGEST_LABEL = 12
"""Maximum width of the name of a joint next to the figure, cells."""


def limb_lines(
    rig: RigView, columns: int, rows: int, turn_deg: float, *, optical: bool, unicode: bool
) -> list[Line] | None:
    """Return the limb as lines; None while fewer than two joints are known.

    Parameters
    ----------
    rig
        Newest messages of the rig.
    columns, rows
        Size of the figure, cells.
    turn_deg
        Direction of view about the vertical, degrees from the subject's right side.
    optical
        Whether the newest pose from the cameras is also drawn, as a dotted figure.
    unicode
        Whether the terminal shows Braille patterns; if not, the figure has ASCII characters.
    """
    pose, info = rig.pose, rig.info
    if pose is None or info is None:
        return None
    forward = _forward(pose, info)
    turn = math.radians(turn_deg + (_BRANCHED_TURN_DEG if info.connections else 0.0))
    across = (
        forward[0] * math.cos(turn) + forward[1] * math.sin(turn),
        forward[1] * math.cos(turn) - forward[0] * math.sin(turn),
    )
    points = _points(pose)
    origin = next((points[name] for name in info.joints if name in points), None)
    if origin is None or len(points) == 1:
        return None
    front, back = (DotCanvas(columns, rows, unicode) for _ in range(2))
    label = min(_LONGEST_LABEL, 1 + max(cell_len(title_of(name)) for name in points))
    scale = _Scale(rig.reach_m, front, max(1, columns - label - 1))

    def dots(places: dict[str, list[float]]) -> dict[str, _Dot]:
        return {name: scale.dot(place, origin, across) for name, place in places.items()}

    joints = dots(points)
    for first, last in _bones(info):
        if first in joints and last in joints:
            _bone(front, joints[first], joints[last])
    for x, y in joints.values():
        _blob(front, x, y)
    if optical and rig.optical is not None:
        seen = dots(_points(rig.optical))
        for first, last in _bones(info):
            if first in seen and last in seen:
                back.line(seen[first], seen[last], every=3 if unicode else 1)
    return _add_names(render(front, "imu", back, "optical"), front, joints, label)


class _Scale:
    """Conversion of metres to dots with equal scales.

    All positions that the limb has reached so far (`RigView.reach_m`) fit on the canvas.
    """

    def __init__(self, reach_m: list[float], canvas: DotCanvas, columns: int) -> None:
        across_m, low_m, high_m = reach_m
        height_m = max(_LEAST_REACH_M, high_m - low_m)
        width_dots = columns * canvas.width / max(1, canvas.columns)
        self._per_m = min(
            (canvas.height - 3) * canvas.aspect / height_m,
            width_dots / max(_LEAST_REACH_M, 2.0 * across_m),
        )
        self._aspect = canvas.aspect
        self._middle = width_dots / 2
        self._top = 1 + high_m * self._per_m / self._aspect

    def dot(self, place: list[float], origin: list[float], across: tuple[float, float]) -> _Dot:
        x_m = (place[0] - origin[0]) * across[0] + (place[1] - origin[1]) * across[1]
        z_m = place[2] - origin[2]
        return (
            round(self._middle + x_m * self._per_m),
            round(self._top - z_m * self._per_m / self._aspect),
        )


def _points(pose: Pose | OpticalPose) -> dict[str, list[float]]:
    """Return the known positions of the joints, m."""
    found: dict[str, list[float]] = {}
    for name, joint in pose.joints.items():
        known = known_vector(joint.p_m, 3)
        if known is not None:
            found[name] = known
    return found


def _forward(pose: Pose, info: Info) -> tuple[float, float]:
    """Return the horizontal direction ahead, normal to the x axis of the first known segment."""
    for name in info.segments:
        segment = pose.segments.get(name)
        q = None if segment is None else known_vector(segment.q, 4)
        if q is None:
            continue
        w, x, y, z = q
        ahead = (-2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
        length = math.hypot(*ahead)
        if length > _LEAST_HORIZONTAL:
            return ahead[0] / length, ahead[1] / length
    return 0.0, 1.0


def _bones(info: Info) -> list[tuple[str, str]]:
    """Return the pair of joints at the ends of each segment."""
    if not info.connections:
        return [*zip(info.joints, info.joints[1:], strict=False)]
    pairs = []
    for segment in info.segments:
        ends = [name for name, one in info.connections.items() if one.child == segment]
        ends += [name for name, one in info.connections.items() if one.parent == segment]
        pairs += [(ends[0], other) for other in ends[1:]]
    return pairs


def _bone(canvas: DotCanvas, first: _Dot, last: _Dot) -> None:
    """Draw a segment as a line that is two dots wide."""
    canvas.line(first, last)
    if canvas.unicode:
        canvas.line((first[0] + 1, first[1]), (last[0] + 1, last[1]))


def _blob(canvas: DotCanvas, x: int, y: int) -> None:
    for dx in (-1, 0, 1, 2) if canvas.unicode else (0,):
        for dy in (-1, 0, 1) if canvas.unicode else (0,):
            canvas.plot(x + dx, y + dy)


def _add_names(
    lines: list[Line], canvas: DotCanvas, joints: dict[str, _Dot], width: int
) -> list[Line]:
    """Write the name of each joint at the right end of its row if the row has space."""
    taken: set[int] = set()
    rows = canvas.height // canvas.rows
    for name, (_, y) in joints.items():
        row = min(canvas.rows - 1, max(0, y // rows))
        line = lines[row]
        free = canvas.columns - width
        if row in taken or len(line.text.rstrip("⠀ ")) > free:
            continue

        taken.add(row)
        lines[row] = line.fit(free) if line.width <= free else _cut(line, free)
        lines[row] = lines[row].add(" " + fit_text(title_of(name), width - 1), "muted")
    return lines


def _cut(line: Line, width: int) -> Line:
    """Return a line cropped to `width` characters."""
    spans, free = [], width
    for text, style in line.spans:
        spans.append((text[:free], style))
        free -= len(spans[-1][0])
    return Line(tuple(spans))
