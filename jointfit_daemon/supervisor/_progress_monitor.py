"""Whether the core does its work: that, and no bare timer, is what feeds systemd's watchdog.

Law: samples that ought to become limb states, and do not, are the only complaint. Silent, absent
or repeating devices are their own trouble: restarting the daemon would not mend them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

_SPENT = ("late", "duplicate", "dropped", "idle")
"""Verdicts on samples that need not bring a limb state about."""


class Progress:
    """Compares the core's counters between two looks."""

    def __init__(self) -> None:
        self._states = self._wanted = 0

    def made(self, health: Mapping[str, object], states: int, imus: frozenset[str]) -> bool:
        """Return whether limb states came out since the last look, or none could.

        Parameters
        ----------
        health
            As the core tells it.
        states
            Limb states made from samples so far.
        imus
            Ids of the devices whose samples make limb states.
        """
        wanted = _wanted(health, imus)
        done = states > self._states or wanted <= self._wanted
        self._states, self._wanted = states, wanted
        return done


def _wanted(health: Mapping[str, object], imus: frozenset[str]) -> int:
    devices = health.get("devices")
    total = 0
    for name, counts in devices.items() if isinstance(devices, dict) else ():
        if name in imus:
            total += counts.get("received", 0) - sum(counts.get(word, 0) for word in _SPENT)
    return total
