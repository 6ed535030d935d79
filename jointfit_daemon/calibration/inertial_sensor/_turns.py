"""Turns of a sensor between rests, with the readings of each turn and gravity at both rests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.calibration.inertial_sensor._rest_blocks import LONGEST_PAUSE_NS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.inertial_sensor._rest_blocks import RestBlock, SensorReading

REST_BLOCKS = 3
"""Number of blocks in the rest before and after a turn: 0.75 s."""
MOST_READINGS = 20_000
"""Largest number of readings in a turn. A longer turn is discarded, because the noise of its
integral grows.
"""


LARGEST_JITTER = 0.4
"""Largest deviation of arrivals from equal spacing, in intervals. A lost reading causes a deviation
of at least half an interval.
"""


class Rest(NamedTuple):
    """Mean readings of a rest."""

    force: Array
    """Specific force, m/s^2, shape (3,)."""
    rate: Array
    """Angular rate at rest, which equals the gyroscope bias, rad/s, shape (3,)."""


@dataclass(frozen=True, slots=True)
class Turn:
    """A movement that begins and ends at rest."""

    t_s: Array
    """Instants of the readings, s, shape (n,)."""
    rates: Array
    """Measured angular rates, rad/s, shape (n, 3)."""
    before: Rest
    after: Rest


class TurnCollector:
    """Collects the turns in a series of readings."""

    def __init__(self) -> None:
        self.turns: list[Turn] = []
        """Turns that have been collected."""
        self._before: Rest | None = None
        self._since: list[SensorReading] = []  # readings since the end of `_before`

    def add(self, reading: SensorReading, rest: Sequence[RestBlock] | None) -> None:
        """Add a reading.

        Parameters
        ----------
        reading
            The next reading.
        rest
            Blocks of the current rest if the reading completed a block, else None.
        """
        since = self._since
        pause_ns = reading.t_ns - since[-1].t_ns if since else 0
        if not 0 <= pause_ns <= LONGEST_PAUSE_NS or len(since) >= MOST_READINGS:
            since.clear()
            self._before = None
        since.append(reading)
        if rest is None or len(rest) <= REST_BLOCKS:
            return

        # the first block may contain the end of the turn
        after = Rest(
            np.mean([block.force for block in rest[1:]], axis=0),
            np.mean([block.rate for block in rest[1:]], axis=0),
        )
        if self._before is not None and len(rest) == REST_BLOCKS + 1:  # a new rest
            t_s = np.array([each.t_ns - since[0].t_ns for each in since]) * 1e-9
            rates = np.array([each.rate for each in since])

            # Arrivals are replaced by equally spaced instants if they deviate only by jitter.
            number = np.arange(len(t_s)) - 0.5 * (len(t_s) - 1)
            period_s = float(number @ t_s / (number @ number))
            regular = t_s.mean() + period_s * number
            if float(np.abs(t_s - regular).max()) < LARGEST_JITTER * period_s:
                t_s = regular
            self.turns.append(Turn(t_s, rates, self._before, after))
        self._before = after
        self._since = [reading]
