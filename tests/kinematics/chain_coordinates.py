"""Functions that return the joint coordinates of a chain by segment name, for tests."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from jointfit_daemon.kinematics.chains import layout_of, rest_state, step_between

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chains import ChainModel, ChainState


def hinge_angles(model: ChainModel, state: ChainState) -> dict[str, Array]:
    """Return the angle of every hinge from its rest, rad, shape (T,) each."""
    rest = replace(rest_state(model, len(state)), origins=state.origins)
    step = step_between(model, rest, state)
    return {
        s.name: step[:, columns.start]
        for s, columns in zip(model.segments, model.columns, strict=True)
        if s.joint.kind == "hinge"
    }


def coupled_coordinates(model: ChainModel, state: ChainState) -> dict[str, Array]:
    """Return the coordinate of every coupled joint, rad, shape (T,) each."""
    if state.couplings is None:
        return {}
    return {
        model.segment_names[segment]: state.couplings[:, c, 0]
        for c, (segment, _, _) in enumerate(layout_of(model).coupled)
    }
