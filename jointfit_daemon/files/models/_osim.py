"""OpenSim models as chain models: the joints of selected bodies, and their markers.

The world and the bodies of OpenSim have y up, x forward and z right. Chain models have z up, y
forward and x right. Every vector (x, y, z) becomes (z, x, y). This includes the axes of bodies, so
the segment frames of both models correspond. Differences between the models are reported as
remarks. Unsupported elements raise an error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.axes import to_z_up
from jointfit_daemon.files.models._osim_coordinates import (
    joint_coordinates,
    unnamed_coordinates,
)
from jointfit_daemon.files.models._osim_document import GROUND, read_document
from jointfit_daemon.files.models._osim_joints import nearest_joint
from jointfit_daemon.files.models._units import require_metres
from jointfit_daemon.files.text import MalformedFileError
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.chains import (
    ChainModel,
    InvalidChainModelError,
    Joint,
    Marker,
    Segment,
)

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.files.models._osim_document import OsimDocument, OsimJoint, OsimMarker
    from jointfit_daemon.files.models._osim_joints import NearestJoint
    from jointfit_daemon.kinematics.chain_coordinates import JointCoordinates
    from jointfit_daemon.kinematics.chains import Sample
    from jointfit_daemon.model import Quaternion, Vector


@dataclass(frozen=True, slots=True)
class ImportedModel:
    """Chain model with remarks on differences from the OpenSim model."""

    model: ChainModel
    remarks: tuple[str, ...]
    coordinates: tuple[JointCoordinates, ...]
    """Coordinates of each segment, with the names of the file."""


def read_osim(path: Path, *, markers: Collection[str] | None = None) -> ImportedModel:
    """Return the chain model of an OpenSim 4 model.

    Parameters
    ----------
    path
        ``.osim`` file.
    markers
        Markers to use; bodies that none of these markers needs are omitted. The default is all
        markers.

    Raises
    ------
    MalformedFileError
        The file is no OpenSim 4 model, contains unsupported joints or functions, unknown names, or
        lengths that are not metres.
    """
    document = read_document(path)
    names = {m.name for m in document.markers}
    unknown = [f"no marker {m!r}" for m in markers or () if m not in names]
    if unknown:
        unknown.append(f"there are: {', '.join(sorted(names)) or 'none'}")
    known = {*document.bodies, GROUND}
    frames = [(f"marker {m.name!r}", "parent", m.body) for m in document.markers]
    for joint in document.joints:
        frames.append((f"joint {joint.name!r}", "parent", joint.parent.body))
        frames.append((f"joint {joint.name!r}", "child", joint.child.body))
    bodies = ", ".join([GROUND, *document.bodies])
    unknown += [
        f"{owner}: {end} frame {body!r} is neither a body nor a frame defined in this element, "
        f"expected one of {bodies}: correct socket_{end}_frame"
        for owner, end, body in frames
        if body not in known
    ]
    if unknown:
        raise MalformedFileError(f"{path}: {'; '.join(unknown)}")

    try:
        tree = _Tree(document)
    except ValueError as error:
        raise MalformedFileError(f"{path}: {error}") from error

    chosen = [m for m in document.markers if markers is None or m.name in markers]
    riders = [rider for m in chosen if (rider := tree.place_marker(m)) is not None]
    keep = tree.needed_segments({m.segment for m in riders}) if riders else set(tree.segments)
    if not riders:
        tree.remarks.append("no markers: all bodies are included")

    segments = tree.kept_segments(keep)
    try:
        model = ChainModel(tuple(segments), tuple(riders), document.name)
    except InvalidChainModelError as error:
        raise MalformedFileError(f"{path}: {error}") from error
    coordinates = tuple(tree.coordinates(segment) for segment in segments)
    return ImportedModel(require_metres(str(path), model), tuple(tree.remarks), coordinates)


class _Tree:
    """Tree of bodies and joints in which parents precede children. Welded bodies are merged."""

    def __init__(self, document: OsimDocument) -> None:
        self.remarks = [
            f"constraint {name} is ignored: its coordinates are independent"
            for name in document.constraints
        ]
        self.segments: dict[str, Segment] = {}
        self._at: dict[str, tuple[str | None, Array]] = {GROUND: (None, np.eye(4))}
        self._told: dict[str, tuple[str, ...]] = {}
        self._joints: dict[str, tuple[OsimJoint, Array]] = {}

        waiting = list(document.joints)
        while waiting:
            ready = [j for j in waiting if j.parent.body in self._at]
            if not ready:
                cycle = ", ".join(f"{j.name} ({j.parent.body} to {j.child.body})" for j in waiting)
                raise ValueError(
                    f"joints form a cycle: {cycle}; expected a path from every body to {GROUND}: "
                    "correct socket_parent_frame of one of them"
                )
            for joint in ready:
                if joint.child.body in self._at:
                    raise ValueError(f"body {joint.child.body!r} has two parent joints")
                nearest = nearest_joint(joint)
                self._joints[joint.child.body] = joint, self._at[joint.parent.body][1]
                self._add(joint.parent.body, joint.child.body, nearest)
            waiting = [j for j in waiting if j not in ready]

        for body in document.bodies:
            if body not in self._at:
                self._add(GROUND, body, None)

    def _add(self, parent_body: str, body: str, joint: NearestJoint | None) -> None:
        """Attach a body to its parent. A body without a `joint` moves freely."""
        parent, placed = self._at[parent_body]
        if joint is not None and joint.kind is None:
            self._at[body] = (parent, placed @ joint.rest)
            self.remarks += joint.remarks
            merged = parent or "the world"
            self.remarks.append(f"{body} is fixed to {merged} and became part of it")
            return
        self._at[body] = (body, np.eye(4))
        self._told[body] = joint.remarks if joint is not None else ()
        if joint is None or joint.kind == "free":
            if parent is not None:
                self._told[body] += (f"{body} moves freely: its parent {parent} is left out",)
            self.segments[body] = Segment(body)
            return

        center = placed[:3, :3] @ joint.center_in_parent + placed[:3, 3]
        rest = rotation.from_matrix(placed[:3, :3] @ joint.rest[:3, :3])
        self.segments[body] = Segment(
            body,
            parent,
            Joint(
                joint.kind or "ball",
                _vector(center),
                _vector(joint.center),
                _vector(joint.axis),
                _z_up_quaternion(rest),
                joint.limits,
                () if joint.path is None else _path(joint.path, placed[:3, :3]),
            ),
        )

    def place_marker(self, marker: OsimMarker) -> Marker | None:
        """Return a marker on its segment; None, with a remark, if it is fixed to the world."""
        segment, transform = self._at[marker.body]
        if segment is None:
            self.remarks.append(f"marker {marker.name} is fixed to the world and left out")
            return None
        at = transform[:3, :3] @ marker.location + transform[:3, 3]
        fixed = marker.fixed
        return Marker(marker.name, segment, _vector(at), locked=(fixed, fixed, fixed))

    def needed_segments(self, marked: set[str]) -> set[str]:
        """Return the segments with markers and the segments that connect them."""
        paths = {name: self._path(name) for name in marked}
        keep = {above for path in paths.values() for above in path}
        for root in [name for name in keep if self.segments[name].parent is None]:
            top: str | None = root
            while top is not None and top not in marked:
                under = [n for n in keep if self.segments[n].parent == top]
                if len(under) > 1:
                    break
                keep.discard(top)
                top = under[0] if under else None
        return keep

    def _path(self, name: str) -> list[str]:
        path, above = [name], self.segments[name].parent
        while above is not None:
            path.append(above)
            above = self.segments[above].parent
        return path

    def kept_segments(self, keep: set[str]) -> list[Segment]:
        """Return the segments to keep. A root whose parent is omitted moves freely."""
        left = [name for name in self.segments if name not in keep]
        if left:
            self.remarks.append(f"omitted, because no marker needs them: {', '.join(left)}")
        found = []
        for name, segment in self.segments.items():
            if name in keep:
                cut = segment.parent is not None and segment.parent not in keep
                found.append(Segment(name) if cut else segment)
                self.remarks += () if cut else self._told[name]
        return found

    def coordinates(self, segment: Segment) -> JointCoordinates:
        """Return the coordinates of a kept segment; six free ones without its parent segment."""
        was_cut = segment.parent is None and (
            segment.name not in self._joints
            or self._at[self._joints[segment.name][0].parent.body][0] is not None
        )
        if was_cut:
            return unnamed_coordinates(segment.name)
        return joint_coordinates(segment, *self._joints[segment.name])


def _vector(v: Array) -> Vector:
    x, y, z = to_z_up(v).tolist()
    return (x, y, z)


def _path(path: Array, placed: Array) -> tuple[Sample, ...]:
    """Return the samples of a coupled joint, converted to the axes of chain models."""
    turns = rotation.multiply(rotation.from_matrix(placed), path[:, 1:5])
    shifts = path[:, 5:] @ placed.T
    return tuple(
        (q, *_z_up_quaternion(turn), *_vector(shift))
        for q, turn, shift in zip(path[:, 0].tolist(), turns, shifts, strict=True)
    )


def _z_up_quaternion(q: Array) -> Quaternion:
    w, x, y, z = q.tolist()
    return (w, z, x, y)
