"""Animated drawing of a walking limb and of the curve of its knee, from the poses of a run.

The animation repeats three times and then stops. With `prefers-reduced-motion` it does not move.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jointfit_daemon.kinematics import rotation
from tests.pictures.svg_style import document, points, text

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from jointfit_daemon.arrays import Array

JOINTS = ("hip", "knee", "ankle")
FRAME_S = 0.08
LONGEST_S, SHORTEST_S = 8.0, 5.0
REPEATS = 3
SIZE = (820, 400)
HIP_X, HIP_Y, METRE = 170.0, 84.0, 330.0
"""Position of the hip in the drawing, and length of a metre, pixels."""
LEFT, RIGHT, TOP, BOTTOM = 380.0, 780.0, 150.0, 330.0
LARGEST_DEG = 80.0
PLACES = (0.3, 0.72)
"""Places of the two sensors of a segment, as shares of its length."""
STYLE = """
.limb { fill: none; stroke: #ead7c5; stroke-width: 38; stroke-linecap: round; }
.limb { stroke-linejoin: round; } .sensor { stroke: #e8710a; stroke-width: 22; }
.band { fill: #1a73e8; fill-opacity: 0.22; } .joint { stroke-width: 3; }
.optical { stroke-width: 4; stroke-dasharray: 9 7; } .number { font-size: 40px; font-weight: 600; }
.still { display: none; }
@media (prefers-reduced-motion: reduce) { .moving { display: none; } .still { display: inline; } }
@media (prefers-color-scheme: dark) { .limb { stroke: #5b4d42; } .sensor { stroke: #f0964a; } }
"""


class Walk(NamedTuple):
    """A run at equal intervals, from the IMUs and from the cameras."""

    t_s: Array
    limb: Array
    """Hip, knee and ankle in the sagittal plane, relative to the hip, m, shape (n, 3, 2)."""
    optical: Array
    flexion_deg: Array
    sd_deg: Array
    optical_deg: Array


def walk(poses: Sequence[dict[str, Any]], optical: Sequence[dict[str, Any]]) -> Walk:
    """Return a part of a run, from complete poses, that ends in nearly the posture of its start."""
    poses, optical = ([pose for pose in each if _is_complete(pose)] for each in (poses, optical))
    forward = _forward(poses)
    imu, cameras = _track(poses, forward), _track(optical, forward)
    begin_s = max(imu[0][0], cameras[0][0])
    t_s = np.arange(begin_s, min(imu[0][-1], cameras[0][-1]), FRAME_S)
    limb, flexion = _at(t_s, imu[0], imu[1]), _at(t_s, imu[0], imu[2])

    first, last = round(SHORTEST_S / FRAME_S), min(round(LONGEST_S / FRAME_S), len(t_s) - 1)
    shape = limb.reshape(len(t_s), -1)
    end = first + int(np.argmin(np.abs(shape[first:last] - shape[0]).max(axis=1))) + 1
    sd = _at(t_s, imu[0], np.array([pose["joints"]["knee"]["sd_deg"] for pose in poses]))
    return Walk(
        t_s[:end] - begin_s,
        limb[:end],
        _at(t_s, cameras[0], cameras[1])[:end],
        flexion[:end],
        sd[:end],
        _at(t_s, cameras[0], cameras[2])[:end],
    )


def _is_complete(pose: dict[str, Any]) -> bool:
    joints = pose["joints"]
    known = all(joints.get(name, {}).get("p_m") is not None for name in JOINTS)
    return known and joints["knee"].get("flexion_deg") is not None


def _forward(poses: Sequence[dict[str, Any]]) -> Array:
    """Return the mean anterior direction of the thigh in the horizontal plane, shape (3,)."""
    q = np.array([pose["segments"]["thigh"]["q"] for pose in poses])
    mean = rotation.rotate(q, np.array([0.0, 1.0, 0.0])).mean(axis=0) * (1.0, 1.0, 0.0)
    return np.asarray(mean / np.linalg.norm(mean))


def _track(poses: Sequence[dict[str, Any]], forward: Array) -> tuple[Array, Array, Array]:
    """Return times (s), joints in the sagittal plane (m) and knee flexion (degrees)."""
    t_s = np.array([pose["t_us"] / 1e6 for pose in poses])
    p = np.array([[pose["joints"][name]["p_m"] for name in JOINTS] for pose in poses])
    p = p - p[:, :1]
    flexion = np.array([pose["joints"]["knee"]["flexion_deg"] for pose in poses])
    return t_s, np.stack([p @ forward, p[..., 2]], axis=-1), flexion


def _at(t_s: Array, known_s: Array, values: Array) -> Array:
    flat = values.reshape(len(values), -1)
    columns = [np.interp(t_s, known_s, column) for column in flat.T]
    return np.stack(columns, axis=1).reshape(len(t_s), *values.shape[1:])


def draw(found: Walk) -> str:
    """Return the animated drawing."""
    duration = f"{found.t_s[-1]:.2f}s"

    def animated(attribute: str, values: Sequence[str]) -> str:
        return (
            f'<animate attributeName="{attribute}" dur="{duration}" repeatCount="{REPEATS}"'
            f' fill="freeze" values="{";".join(values)}"/>'
        )

    body = [
        text(24, 36, "Walking with four IMUs", "strong"),
        text(24, 60, "cameras: dashed"),
        text(LEFT, 36, "Knee flexion", "strong"),
        *_scale(),
        *_curves(found),
        '<g class="still">',
        *_limb(found, lambda _, __: "", len(found.t_s) // 3),
        text(LEFT, 90, f"0 to {found.flexion_deg.max():.0f}°", "number"),
        "</g>",
        '<g class="moving">',
        *_limb(found, animated, 0),
        *_numbers(found, duration),
        *_pointer(found, animated),
        "</g>",
    ]
    description = (
        f"A right leg walks for {found.t_s[-1]:.0f} s, seen from the right, computed from two IMUs"
        " on the thigh and two on the shank, with the reference of the cameras as a dashed line."
        " The curve is the knee flexion with its 95 % interval. Simulated subject, live output of"
        " jointfitd."
    )
    return document(SIZE, "Walking leg and its knee flexion", description, body, STYLE)


def _x(found: Walk) -> Array:
    return np.asarray(LEFT + (RIGHT - LEFT) * found.t_s / found.t_s[-1])


def _y(degrees: Array) -> Array:
    return np.asarray(BOTTOM - (BOTTOM - TOP) * degrees / LARGEST_DEG)


def _scale() -> list[str]:
    lines = []
    for degrees in (0, 40, 80):
        y = float(_y(np.array(degrees)))
        lines.append(f'<path class="grid" d="M{LEFT} {y:g} H{RIGHT}"/>')
        lines.append(text(LEFT - 8, y + 6, f"{degrees}°", "soft right"))
    return lines


def _curves(found: Walk) -> list[str]:
    x, low, high = (
        _x(found),
        found.flexion_deg - 2 * found.sd_deg,
        found.flexion_deg + 2 * found.sd_deg,
    )
    outline = [*zip(x, _y(high), strict=True), *zip(x[::-1], _y(low)[::-1], strict=True)]

    def curve(kind: str, degrees: Array) -> str:
        drawn = points(zip(x, _y(degrees), strict=True))
        return f'<polyline class="line {kind}" points="{drawn}"/>'

    return [
        f'<polygon class="band" points="{points(outline)}"/>',
        curve("gray dashed", found.optical_deg),
        curve("blue", found.flexion_deg),
        text(LEFT, 372, "blue: IMUs, with 95 % interval; dashed: cameras"),
    ]


def _limb(found: Walk, animated: Callable[[str, Sequence[str]], str], shown: int) -> list[str]:
    """Return limb, sensors and camera reference; `shown` is the frame of the still picture."""

    def line(kind: str, xy: Array) -> str:
        frames = [points(frame.tolist()) for frame in xy]
        moves = animated("points", frames)
        return f'<polyline class="{kind}" points="{frames[shown]}">{moves}</polyline>'

    limb, optical = (np.stack([HIP_X + METRE * p[..., 0], HIP_Y - METRE * p[..., 1]], axis=-1)
                     for p in (found.limb, found.optical))  # fmt: skip
    lines = [line("limb", limb)]
    for above in (0, 1):
        along = limb[:, above + 1] - limb[:, above]
        half = 13.0 * along / np.linalg.norm(along, axis=1, keepdims=True)
        for place in PLACES:
            middle = limb[:, above] + place * along
            lines.append(line("sensor", np.stack([middle - half, middle + half], axis=1)))
    lines.append(line("line gray optical", optical))
    for joint in range(len(JOINTS)):
        x, y = ([f"{v:.1f}" for v in limb[:, joint, axis]] for axis in (0, 1))
        moves = animated("cx", x) + animated("cy", y)
        lines.append(
            f'<circle class="joint" r="7" cx="{x[shown]}" cy="{y[shown]}">{moves}</circle>'
        )
    return lines


def _numbers(found: Walk, duration: str) -> list[str]:
    """Return one text for every second frame, visible until the next."""
    numbers = []
    rows = [*range(0, len(found.t_s) - 1, 2), len(found.t_s) - 1]
    for row in rows:
        begin, end = (min(k / (len(found.t_s) - 1), 1.0) for k in (row, row + 2))
        times, states = f"0;{begin:.4f};{end:.4f}", "hidden;visible;hidden"
        if row == rows[-1]:
            times, states = "0;1", "hidden;visible"
        words = f"{found.flexion_deg[row]:.0f}° ± {found.sd_deg[row]:.0f}°"
        numbers.append(
            f'<text class="number" x="{LEFT:g}" y="90" visibility="hidden">{words}<animate'
            f' attributeName="visibility" dur="{duration}" repeatCount="{REPEATS}" fill="freeze"'
            f' calcMode="discrete" keyTimes="{times}" values="{states}"/></text>'
        )
    return numbers


def _pointer(found: Walk, animated: Callable[[str, Sequence[str]], str]) -> list[str]:
    """Return the point that moves along the curve."""
    x, y = ([f"{v:.1f}" for v in values] for values in (_x(found), _y(found.flexion_deg)))
    moves = animated("cx", x) + animated("cy", y)
    return [f'<circle class="blue-fill" r="8" cx="{x[0]}" cy="{y[0]}">{moves}</circle>']
