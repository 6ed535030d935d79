"""Limb from ``[[chain.joint]]`` tables: a tree with a right and a left branch.

Invariant: `branched_limb` orders joints and segments so that every segment follows its proximal
segment, and joint i is the proximal joint of segment i.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.config._fault_messages import Fault
from jointfit_daemon.nearest_name import nearest_name

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from jointfit_daemon.config._tables import ChainTable, JointTable

_KEY = "chain.joint"
_BRANCHES = 2
"""Number of joints at the distal end of the first segment."""


class BranchedLimb(NamedTuple):
    """A limb with branches, in the order of `Chain`."""

    joints: tuple[str, ...]
    segments: tuple[str, ...]
    parents: tuple[int | None, ...]
    """Index of the segment proximal of each joint; None for the origin."""
    left: tuple[bool, ...]
    """Whether each joint is on the left side."""
    distals: tuple[str | None, ...]
    """Body part distal of the last joint of each branch; None for a branch without such a part."""


def branched_limb(table: ChainTable) -> BranchedLimb:
    """Return the limb that `table` describes; `table` must have no faults.

    The position of the first segment is published under the name ``NAME_origin``. It is the
    midpoint of the segment's two distal joints.
    """
    joints, segments = table.joint, set(table.segments)
    carried = {j.child: j for j in joints if j.child is not None and j.child in segments}
    root = _roots(table)[0]

    # The order is depth first, so the segments of a branch are contiguous.
    order: list[str] = []
    waiting = [root]
    while waiting:
        order.append(waiting.pop())
        waiting += [c for c, j in reversed(carried.items()) if j.parent == order[-1]]
    ends = [
        joint
        for segment in order
        for joint in joints
        if joint.parent == segment and joint.child not in segments
    ]

    tables = [*(carried[segment] for segment in order[1:]), *ends]
    return BranchedLimb(
        (origin_name(root), *(joint.name for joint in tables)),
        tuple(order),
        (None, *(order.index(joint.parent) for joint in tables)),
        (False, *(_side_of(joint, carried) == "left" for joint in tables)),
        tuple(joint.child for joint in ends),
    )


def origin_name(root: str) -> str:
    """Return the name of the origin of the first segment, which is published like a joint."""
    return f"{root}_origin"


def _side_of(joint: JointTable, carried: Mapping[str, JointTable]) -> str | None:
    """Return the configured side of a joint, or the side of the nearest joint proximal of it."""
    above: JointTable | None = joint
    while above is not None:
        if above.side is not None:
            return above.side
        above = carried.get(above.parent)
    return None


def _roots(table: ChainTable) -> list[str]:
    children = {joint.child for joint in table.joint}
    return [segment for segment in table.segments if segment not in children]


def check_branches(table: ChainTable) -> list[Fault]:
    """Check that the joints connect all segments to one tree.

    In `table`, a key whose value could not be read is None. Each check requires that the checks
    before it found no fault. The result contains the faults of keys that only limbs without
    branches have, and the faults of the first check that found any.
    """
    given = {"joints": table.joints, "proximal": table.proximal, "distal": table.distal}
    given["side"] = "left" if table.side == "left" else None
    given["motion"] = "planar" if table.motion == "planar" else None
    faults = [
        Fault(f"chain.{key}", "is for a limb without branches; remove it, or [[chain.joint]]")
        for key, value in given.items()
        if value
    ]
    joints, segments = table.joint, table.segments
    if not joints or not segments:
        return faults
    for check in (_check_names, _check_parents, _check_connection, _check_shape, _check_sides):
        if found := [*check(table)]:
            return [*faults, *found]
    return faults


def _check_names(table: ChainTable) -> Iterator[Fault]:
    for name, times in Counter(joint.name for joint in table.joint).items():
        parents = [joint.parent for joint in table.joint if joint.name == name]
        if times > 1:
            text = f"{times} tables have this name (parents: {_join(parents)}), expected one"
            yield Fault(_KEY, text, name)
    for joint in table.joint:
        key = f"{_KEY}[{joint.name}]"
        if joint.parent not in table.segments:
            known = ", ".join(table.segments)
            near = nearest_name(joint.parent, table.segments)
            yield Fault(f"{key}.parent", f"unknown segment; known: {known}", joint.parent, near)
        if joint.child == joint.parent:
            yield Fault(f"{key}.child", "is also its parent, expected another segment", joint.child)


def _check_parents(table: ChainTable) -> Iterator[Fault]:
    owners: dict[str, str] = {}
    for joint in table.joint:
        first = joint.name if joint.child is None else owners.setdefault(joint.child, joint.name)
        if first != joint.name:
            text = f"is the child of {first!r} already: a segment has one proximal joint"
            yield Fault(f"{_KEY}[{joint.name}].child", text, joint.child)


def _check_connection(table: ChainTable) -> Iterator[Fault]:
    """Check that every segment has a joint, that there is one root, and that there is no cycle."""
    used = {name for joint in table.joint for name in (joint.parent, joint.child)}
    roots = _roots(table)
    for segment in (name for name in table.segments if name not in used):
        text = "is in no [[chain.joint]]: add a joint that connects this segment, or remove it"
        yield Fault("chain.segments", text, segment)
    connected = [name for name in roots if name in used]
    if len(connected) > 1:
        text = (
            f"have no proximal joint: {_join(connected)}; expected one such segment (the root): "
            "name the others as child of a joint"
        )
        loose = [joint.child for joint in table.joint if joint.child not in table.segments]
        near = [nearest_name(name, [c for c in loose if c]) for name in connected]
        yield Fault("chain.segments", text, near=next(filter(None, near), None))

    above = {joint.child: joint.parent for joint in table.joint}
    reported: set[str] = set()
    for segment in table.segments:
        path = [segment]
        while (parent := above.get(path[-1])) is not None and parent not in path:
            path.append(parent)
        if parent is not None and parent not in reported:
            cycle = [*path[path.index(parent) :], parent]
            reported.update(cycle)
            shown = " – ".join(reversed(cycle))
            yield Fault(_KEY, f"form a cycle: {shown}; expected one segment without parent")


def _check_shape(table: ChainTable) -> Iterator[Fault]:
    """Check the number of joints at the distal end of each segment: two at the root, else one.

    No joint may have the name of the origin.
    """
    root = _roots(table)[0]
    for segment in table.segments:
        names = [joint.name for joint in table.joint if joint.parent == segment]
        found = f"segment {segment!r} carries {len(names)} joints ({_join(names) or 'none'})"
        if segment == root and len(names) != _BRANCHES:
            text = "expected a right and a left one; a limb without branches has the key `joints`"
            yield Fault(_KEY, f"{found}, {text}")
        elif segment != root and not names:
            text = f"add its distal end with parent = {segment!r}, such as the ankle of a shank"
            yield Fault(_KEY, f"{found}, expected one: {text}; this joint needs no child")
        elif segment != root and len(names) > 1:
            text = f"expected one: only the first segment ({root!r}) has branches"
            yield Fault(_KEY, f"{found}, {text}")
    if origin_name(root) in {joint.name for joint in table.joint}:
        yield Fault(_KEY, f"is the name of the origin of {root!r}: rename it", origin_name(root))


def _check_sides(table: ChainTable) -> Iterator[Fault]:
    root = _roots(table)[0]
    first = [joint for joint in table.joint if joint.parent == root]
    if sorted(str(joint.side) for joint in first) != ["left", "right"]:
        found = _join([f"{joint.name}: {joint.side or 'no side'}" for joint in first])
        text = f'expected side = "right" and side = "left" on the joints of {root!r}, found {found}'
        yield Fault(_KEY, text)
    carried = {joint.child: joint for joint in table.joint if joint.child is not None}
    for joint in table.joint:
        if joint.parent != root and joint.side is not None:
            above = _side_of(carried[joint.parent], carried)
            if joint.side != above:
                text = f"expected {above!r}, like the joint above it"
                yield Fault(f"{_KEY}[{joint.name}].side", text, joint.side)


def _join(names: Sequence[str]) -> str:
    return ", ".join(names)
