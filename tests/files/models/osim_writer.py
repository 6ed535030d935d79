"""Writes small OpenSim 4 models with given bodies, joints and markers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

Triple = tuple[float, float, float]
LINEAR = "<LinearFunction name='function'><coefficients>1 0</coefficients></LinearFunction>"
ZERO = "<Constant name='function'><value>0</value></Constant>"


def spline(x: list[float], y: list[float], scale: float = 1.0) -> str:
    return (
        "<MultiplierFunction name='function'><function><SimmSpline name='function'>"
        f"<x>{' '.join(map(str, x))}</x><y>{' '.join(map(str, y))}</y></SimmSpline></function>"
        f"<scale>{scale}</scale></MultiplierFunction>"
    )


@dataclass
class Hung:
    """One body and the joint that connects it to its parent."""

    body: str
    parent: str
    kind: str
    coordinates: list[tuple[str, float, float]] = field(default_factory=list)
    in_parent: tuple[Triple, Triple] = ((0, 0, 0), (0, 0, 0))
    """Translation and orientation of the joint's frame in the parent."""
    in_child: tuple[Triple, Triple] = ((0, 0, 0), (0, 0, 0))
    axes: list[tuple[str, Triple, str]] = field(default_factory=list)
    """Coordinate, axis and function of each transform axis of a CustomJoint."""
    locked: bool = False


def triple(values: Triple) -> str:
    return " ".join(map(str, values))


def frame(name: str, body: str, placed: tuple[Triple, Triple]) -> str:
    socket = "/ground" if body == "ground" else f"/bodyset/{body}"
    return (
        f"<PhysicalOffsetFrame name='{name}'><socket_parent>{socket}</socket_parent>"
        f"<translation>{triple(placed[0])}</translation>"
        f"<orientation>{triple(placed[1])}</orientation></PhysicalOffsetFrame>"
    )


def joint(h: Hung) -> str:
    coordinates = "".join(
        f"<Coordinate name='{name}'><default_value>0</default_value><range>{low} {high}</range>"
        f"<clamped>false</clamped><locked>{str(h.locked).lower()}</locked></Coordinate>"
        for name, low, high in h.coordinates
    )
    axes = "".join(
        f"<TransformAxis name='{name}'><coordinates>{coordinate}</coordinates>"
        f"<axis>{triple(axis)}</axis>{function}</TransformAxis>"
        for name, (coordinate, axis, function) in zip(
            ("rotation1", "rotation2", "rotation3", "translation1", "translation2", "translation3"),
            h.axes,
            strict=False,
        )
    )
    frames = frame("above", h.parent, h.in_parent) + frame("own", h.body, h.in_child)
    return (
        f"<{h.kind} name='{h.body}_joint'><socket_parent_frame>above</socket_parent_frame>"
        f"<socket_child_frame>own</socket_child_frame><coordinates>{coordinates}</coordinates>"
        f"<frames>{frames}</frames>"
        + (f"<SpatialTransform>{axes}</SpatialTransform>" if h.axes else "")
        + f"</{h.kind}>"
    )


def write_osim(path: Path, hung: list[Hung], markers: list[tuple[str, str, Triple, bool]]) -> Path:
    """Write a model; a marker consists of name, body, location, m, and whether it is fixed."""
    bodies = "".join(
        f"<Body name='{h.body}'><mass>1</mass><mass_center>0 0 0</mass_center>"
        "<inertia>0.1 0.1 0.1 0 0 0</inertia></Body>"
        for h in hung
    )
    marked = "".join(
        f"<Marker name='{name}'><socket_parent_frame>/bodyset/{body}</socket_parent_frame>"
        f"<location>{triple(at)}</location><fixed>{str(fixed).lower()}</fixed></Marker>"
        for name, body, at, fixed in markers
    )
    path.write_text(
        "<?xml version='1.0' encoding='UTF-8'?>\n<OpenSimDocument Version='40000'>"
        "<Model name='small'><Ground name='ground'/><gravity>0 -9.8 0</gravity>"
        f"<BodySet><objects>{bodies}</objects></BodySet>"
        f"<JointSet><objects>{''.join(map(joint, hung))}</objects></JointSet>"
        f"<MarkerSet><objects>{marked}</objects></MarkerSet></Model></OpenSimDocument>"
    )
    return path
