"""Locks and weights of markers by name, in command-line options and in rig.toml."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from jointfit_daemon.nearest_name import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from jointfit_daemon.kinematics.chains import ChainModel

ALL = "*"
"""Name that stands for all markers."""
_AXES = "xyz"


def require_marker(chain: ChainModel, name: str, option: str) -> None:
    """Check the marker name in an option.

    Raises
    ------
    ValueError
        The model has no such marker.
    """
    names = chain.marker_names
    if name not in names:
        hint = did_you_mean(name, names, count=3) or f"there are: {', '.join(names)}"
        raise ValueError(f"{option} {name}: unknown marker; {hint}")


def with_weights(chain: ChainModel, weights: Mapping[str, float], option: str) -> ChainModel:
    """Return the chain with new weights of some markers; messages contain the name `option`.

    Raises
    ------
    ValueError
        A marker is unknown, or no weight is above 0.
    """
    for name in weights:
        require_marker(chain, name, option)
    if not any(weights.get(m.name, m.weight) > 0.0 for m in chain.markers):
        raise ValueError(f"{option} every weight is 0, expected at least one above 0")
    markers = (replace(m, weight=weights.get(m.name, m.weight)) for m in chain.markers)
    return replace(chain, markers=tuple(markers))


def with_locks(chain: ChainModel, texts: Iterable[str], option: str, *, locked: bool) -> ChainModel:
    """Return the chain with coordinates locked or unlocked.

    Parameters
    ----------
    texts
        ``NAME`` for a marker, ``NAME.x`` for one of its coordinates, ``*`` for all markers. If a
        marker has the name ``NAME.x``, the text refers to this marker.
    option
        Name of the option in messages.

    Raises
    ------
    ValueError
        A marker is unknown.
    """
    locks = {m.name: list(m.locked) for m in chain.markers}
    for text in texts:
        if text == ALL:
            locks = {name: [locked] * 3 for name in locks}
            continue
        name, dot, axis = text.rpartition(".")
        if text in locks or not dot or axis not in tuple(_AXES):
            name, axis = text, _AXES
        require_marker(chain, name, option)
        for letter in axis:
            locks[name][_AXES.index(letter)] = locked

    return chain.with_locks({name: (x, y, z) for name, (x, y, z) in locks.items()})
