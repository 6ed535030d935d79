"""Progress of the core, the condition for the watchdog of systemd.

Invariant: only samples that should produce limb states, and do not, stop the watchdog signal.
Missing or stuck devices do not trip the watchdog, since a restart would not help.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

_OUTCOMES_WITHOUT_STATE = ("late", "duplicate", "dropped", "idle")
"""Outcomes of samples that do not contribute to a limb state."""


class ProgressMonitor:
    """Compares the counters of the core between two calls."""

    def __init__(self) -> None:
        self._states = self._expected = 0

    def has_progressed(
        self, health: Mapping[str, object], states: int, imus: frozenset[str]
    ) -> bool:
        """Return whether limb states were produced since the last call, or none was expected.

        Parameters
        ----------
        health
            Health of the core.
        states
            Number of limb states computed from samples so far.
        imus
            Ids of the devices whose samples produce limb states.
        """
        devices = health.get("devices")
        expected = sum(
            counts.get("received", 0)
            - sum(counts.get(outcome, 0) for outcome in _OUTCOMES_WITHOUT_STATE)
            for name, counts in (devices.items() if isinstance(devices, dict) else ())
            if name in imus
        )
        progressed = states > self._states or expected <= self._expected
        self._states, self._expected = states, expected
        return progressed
