"""Sequence of motions with smooth blends, which can be changed during the run.

Invariant: a switch changes later coordinates only, with two continuous derivatives.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_simulators.body._posture import smootherstep

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from jointfit_simulators.body._motion import Motion


class Step(NamedTuple):
    """One motion of a programme."""

    name: str
    seconds: float


class UnknownMotionError(LookupError):
    """Nobody taught the person that motion."""


def parse_motion_script(text: str) -> tuple[Step, ...]:
    """Return the steps of ``"plate:20,stand:8,walk:60"``; the last one goes on for ever.

    Raises
    ------
    ValueError
        A step is not NAME or NAME:SECONDS with positive seconds.
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
    """The motions of one run, layered: each newer one fades in over the older ones.

    Parameters
    ----------
    motions
        What can be played, by name.
    steps
        What is played from `start_s` on; the last step goes on for ever.
    start_s
        Instant of the first step, s.
    transition_s
        Length of every blend, s.
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
        for step in steps:
            self._layers.append((start_s, self._known(step.name)))
            start_s += step.seconds
        if not self._layers:
            raise ValueError("a programme needs at least one step")

    def _known(self, name: str) -> str:
        if name not in self._motions:
            raise UnknownMotionError(f"no motion {name!r}; there are: {', '.join(self._motions)}")
        return name

    def play(self, name: str, t_s: float) -> None:
        """Begin motion `name` at instant `t_s` and forget what was planned after it."""
        self._known(name)
        kept = [layer for layer in self._layers if layer[0] < t_s]
        self._layers = [*(kept or self._layers[:1]), (t_s, name)]

    def name_at(self, t_s: float) -> str:
        """Return the motion that is on (or fading in) at `t_s`."""
        begun = [name for start, name in self._layers if start <= t_s]
        return begun[-1] if begun else self._layers[0][1]

    def discard_before(self, t_s: float) -> None:
        """Drop what can no longer be seen from `t_s` on."""
        covered = [
            i for i, (start, _) in enumerate(self._layers) if start + self._transition_s <= t_s
        ]
        if covered:
            del self._layers[: covered[-1]]

    def coordinates(self, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the coordinates at instants `t_s` of shape (n,), shape (n, width)."""
        start, name = self._layers[0]
        found = self._motions[name](t_s - start)
        for start, name in self._layers[1:]:
            begun = t_s > start
            if not np.any(begun):
                break
            share = smootherstep((t_s[begun] - start) / self._transition_s)[:, None]
            found[begun] += share * (self._motions[name](t_s[begun] - start) - found[begun])
        return found
