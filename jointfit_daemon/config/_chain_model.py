"""The chain model of ``[chain] model``, and its agreement with the rig.

A model file has its own segment names. A body part of the rig therefore corresponds to the segment
of the model that carries the markers of this body part.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jointfit_daemon.calibration import ChainRefinement
from jointfit_daemon.calibration.marker_refinement import (
    RefinementSettings,
    SearchSettings,
    with_locks,
    with_weights,
)
from jointfit_daemon.config._checks import body_parts_of
from jointfit_daemon.config._fault_messages import Fault
from jointfit_daemon.files.models import (
    LoadedModel,
    as_data,
    load_model,
    model_of,
    read_marker_weights,
)
from jointfit_daemon.files.text import MalformedFileError
from jointfit_daemon.kinematics.chain_coordinates import default_coordinates
from jointfit_daemon.name_lists import list_names
from jointfit_daemon.nearest_name import nearest_name

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from jointfit_daemon.config._tables import ChainRefinementTable, ChainTable
    from jointfit_daemon.driver import MocapSettings
    from jointfit_daemon.kinematics.chains import ChainModel

KEY = "chain.model"
REFINEMENT_KEY = "calibration.chain_refinement"


def read_chain_model(given: str | dict[str, Any]) -> LoadedModel:
    """Return the model of a file, or of a table with the keys of a TOML model.

    Raises
    ------
    MalformedFileError
        The file is damaged, or its content is wrong.
    OSError
        The file cannot be read.
    """
    if isinstance(given, str):
        return load_model(Path(given))
    chain = model_of(given, KEY)
    return LoadedModel(chain, default_coordinates(chain))


def content_of(model: LoadedModel) -> dict[str, Any]:
    """Return a model as a table. `read_chain_model` converts it back, with default coordinates."""
    return as_data(model.chain)


def load_chain_model(
    given: str | dict[str, Any], table: ChainTable, mocap: MocapSettings | None
) -> tuple[LoadedModel | None, list[Fault]]:
    """Return the chain model that `given` names or contains, and its faults.

    In `table` and `mocap`, keys that had faults are None. The remarks of the returned model list
    the rig's markers that the model does not contain.
    """
    try:
        loaded = read_chain_model(given)
    except MalformedFileError as error:
        return None, [Fault(KEY, str(error))]
    except OSError as error:
        text = f"cannot be read ({error.strerror}): expected a .toml, .json or .osim file there"
        return None, [Fault(KEY, text, given)]
    if mocap is None:
        return loaded, [Fault(KEY, "needs cameras, which track its markers: add [mocap]")]

    named: Any = mocap.markers
    if named is None or None in named.values():
        return loaded, []  # Unreadable markers may be markers of the model.

    parts = body_parts_of(table)
    markers = {part: names for part in parts if (names := (mocap.markers or {}).get(part))}
    faults = [*_check_markers(loaded.chain, markers)]
    faults += [
        Fault(
            f"mocap.markers.{segment}",
            "missing; chain.model is tracked by single markers: name the markers of this segment "
            "(a rigid body does not suffice)",
        )
        for segment in table.segments or ()
        if segment not in markers
    ]
    carriers, more = _find_carriers(loaded.chain, markers)
    faults += more or _check_connections(loaded.chain, carriers, _adjacent(table, carriers))
    known = set(loaded.chain.marker_names)
    if absent := [name for names in markers.values() for name in names if name not in known]:
        remark = f"not in the model, so not tracked by it: {list_names(absent)}"
        loaded = replace(loaded, remarks=(*loaded.remarks, remark))
    return loaded, faults


def load_refinement(
    model: ChainModel, table: ChainRefinementTable
) -> tuple[ChainRefinement | None, dict[str, float], list[Fault]]:
    """Return the refinement settings of a chain model, the weights of its markers, and the faults.

    Keys of `table` that had faults are None. If there is such a key, no refinement is returned.
    """
    faults: list[Fault] = []

    def fail(key: str, text: str, value: object) -> None:
        faults.append(Fault(f"{REFINEMENT_KEY}.{key}", text, value))

    weights: dict[str, float] = {}
    try:
        given = table.weights or {}
        weights = read_marker_weights(Path(given)) if isinstance(given, str) else given
        model = with_weights(model, weights, "marker")
    except OSError as error:
        text = f"cannot be read ({error.strerror}): check the path, or write the weights here"
        fail("weights", text, table.weights)
    except ValueError as error:  # includes MalformedFileError
        fail("weights", str(error), table.weights)
    for key, locked in (("unlock", False), ("lock", True)):
        try:
            model = with_locks(model, getattr(table, key) or (), "marker", locked=locked)
        except ValueError as error:
            fail(key, str(error), list(getattr(table, key)))
    if faults or None in dict(table).values():
        return None, weights, faults
    settings = RefinementSettings(
        table.method,
        table.prior,
        cost=table.cost,
        frames=table.frames,
        holdout_share=table.holdout,
        search=SearchSettings(1e-3 * table.first_step_mm, 1e-3 * table.threshold_mm),
    )
    return ChainRefinement(model, settings, table.limit_s), weights, []


def _check_markers(model: ChainModel, markers: Mapping[str, Sequence[str]]) -> Iterator[Fault]:
    """Check that the rig has the markers of the model, and that they determine its segments."""
    known = [name for names in markers.values() for name in names]
    other = [m.name for m in model.markers if m.weight > 0.0 and m.name not in known]
    if other:
        yield Fault(
            KEY,
            f"has markers that are not in mocap.markers: {list_names(other)}; add them there, or "
            "remove them from the model",
            near=nearest_name(other[0], [name for name in known if name not in model.marker_names]),
        )

    needed = {m.segment for m in model.markers}
    for segment in reversed(model.segments):
        if segment.name in needed and segment.parent is not None:
            needed.add(segment.parent)
    bare = [segment.name for segment in model.segments if segment.name not in needed]
    if bare:
        yield Fault(
            KEY,
            f"has segments without markers on them or below them: {list_names(bare)}; remove them "
            "from the model, or add markers",
        )


def _find_carriers(
    model: ChainModel, markers: Mapping[str, Sequence[str]]
) -> tuple[dict[str, str], list[Fault]]:
    """Return the segment of the model that carries the markers of each body part, and faults."""
    of = {m.name: m.segment for m in model.markers}
    carriers: dict[str, str] = {}
    faults: list[Fault] = []
    for part, names in markers.items():
        key = f"mocap.markers.{part}"
        counted = Counter(of[name] for name in names if name in of)
        if not counted:
            text = f"none of these markers is in chain.model, which has {list_names(list(of))}"
            faults.append(Fault(key, f"{text}: rename them here or in the model", list(names)))
            continue

        carrier = carriers[part] = counted.most_common(1)[0][0]
        faults += [
            Fault(
                key,
                f"chain.model has {name} on {of[name]!r} and the other markers of this part on "
                f"{carrier!r}: correct the segment of {name} in the model, or its part in the rig",
            )
            for name in names
            if name in of and of[name] != carrier
        ]
        if before := [p for p in carriers if p != part and carriers[p] == carrier]:
            text = f"chain.model has these markers on {carrier!r}, like those of {before[0]!r}"
            faults.append(Fault(key, f"{text}: expected another segment for each part"))
    return carriers, faults


def _adjacent(table: ChainTable, parts: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return the pairs of body parts that a joint connects."""
    if not table.joint:
        return list(pairwise(parts))
    pairs = [(joint.parent, joint.child) for joint in table.joint if joint.child]
    return [pair for pair in pairs if pair[0] in parts and pair[1] in parts]


def _check_connections(
    model: ChainModel, carriers: Mapping[str, str], adjacent: Sequence[tuple[str, str]]
) -> list[Fault]:
    """Check that the model has a joint between the segments of adjacent parts.

    Segments without markers of the rig may lie between them, such as the talus.
    """
    parents = {s.name: s.parent for s in model.segments}

    def above(name: str) -> list[str]:
        path, parent = [], parents[name]
        while parent is not None:
            path.append(parent)
            parent = parents[parent] if parent not in carriers.values() else None
        return path

    faults, parts = [], list(carriers)
    for first, second in adjacent:
        one, other = carriers[first], carriers[second]
        if one not in above(other) and other not in above(one):
            text = (
                f"has no joint between {one!r} (part {first!r} of the rig) and {other!r} (part "
                f"{second!r}), expected the chain {' – '.join(parts)}: connect them in the model"
            )
            faults.append(Fault(KEY, text))
    return faults
