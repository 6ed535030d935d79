"""Sequence of motions with smooth blends, which can be changed during the run.

Invariant: a new motion changes later coordinates only, with two continuous derivatives.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_simulators.body._posture import smootherstep

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_simulators.body._motion import Motion


class Step(NamedTuple):
    """One motion of a sequence."""

    name: str
    seconds: float


class UnknownMotionError(LookupError):
    """The motion does not exist; the message lists the available motions."""


def parse_motion_script(text: str) -> tuple[Step, ...]:
    """Return the steps of a text ``"plate:20,stand:8,walk:60"``; the last motion continues.

    Raises
    ------
    ValueError
        A step does not have the form NAME or NAME:SECONDS with positive seconds.
    """
    steps = []
    for part in text.split(","):
        name, _, seconds = part.strip().partition(":")
        try:
            length = float(seconds) if seconds else 10.0
        except ValueError:
            length = 0.0
        if not name or not length > 0:
            raise ValueError(f"programme step {part!r}: expected NAME:SECONDS, such as walk:60")
        steps.append(Step(name, length))
    return tuple(steps)


class MotionScript:
    """Sequence of motions of one run; a new motion gradually replaces the old motions.

    Parameters
    ----------
    motions
        Available motions by name.
    steps
        Sequence of motions from `start_s` on. The last motion continues.
    start_s
        Start of the first step, s.
    transition_s
        Duration of every blend, s.
    """

    def __init__(
        self,
        motions: Mapping[str, Motion],
        steps: Iterable[Step],
        *,
        start_s: float = 0.0,
        transition_s: float = 1.5,
    ) -> None:
        self._motions = motions
        self._transition_s = transition_s
        self._layers: list[tuple[float, str]] = []
        self._at_once: set[tuple[float, str]] = set()
        """Motions that begin without a blend."""
        for step in steps:
            self._check(step.name)
            self._layers.append((start_s, step.name))
            start_s += step.seconds
        if not self._layers:
            raise ValueError("a programme needs at least one step")

    def _check(self, name: str) -> None:
        if name not in self._motions:
            raise UnknownMotionError(f"no motion {name!r}; there are: {', '.join(self._motions)}")

    def play(self, name: str, t_s: float, *, at_once: bool = False) -> None:
        """Start the motion `name` at the time `t_s`, without a blend if `at_once`.

        Later steps are discarded.
        """
        self._check(name)
        if at_once:
            self._at_once.add((t_s, name))
        earlier = [layer for layer in self._layers if layer[0] < t_s]
        self._layers = [*(earlier or self._layers[:1]), (t_s, name)]

    def name_at(self, t_s: float) -> str:
        """Return the name of the motion that plays or begins at `t_s`."""
        begun = [name for start, name in self._layers if start <= t_s]
        return begun[-1] if begun else self._layers[0][1]

    def discard_before(self, t_s: float) -> None:
        """Discard the motions that have no effect from `t_s` on."""
        covered = [
            i for i, layer in enumerate(self._layers) if layer[0] + self._blend_s(layer) <= t_s
        ]
        if covered:
            del self._layers[: covered[-1]]

    def _blend_s(self, layer: tuple[float, str]) -> float:
        return 0.0 if layer in self._at_once else self._transition_s

    def coordinates(self, t_s: Array) -> Array:
        """Return the coordinates, shape (n, COORDINATES), at the times `t_s` of shape (n,)."""
        start, name = self._layers[0]
        blended = self._motions[name](t_s - start)
        for layer in self._layers[1:]:
            start, name = layer
            begun = t_s > start
            if not np.any(begun):
                break
            blend_s = self._blend_s(layer)
            since = t_s[begun] - start
            share = smootherstep(since / blend_s if blend_s else np.ones_like(since))[:, None]
            blended[begun] += share * (self._motions[name](t_s[begun] - start) - blended[begun])
        return blended
