"""Progress of the core, on which the signal to the watchdog of systemd depends.

Invariant: the signal stops only if samples that should produce limb states do not produce any.
Missing or stuck devices do not trip the watchdog, because a restart would not help.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.pipeline.health import CoreHealth

_OUTCOMES_WITHOUT_STATE = ("late", "duplicate", "dropped", "idle")
"""Outcomes of samples that contribute to no limb state."""


class ProgressMonitor:
    """Compares the counters of the core between two calls."""

    def __init__(self) -> None:
        self._states = self._expected = 0

    def has_progressed(self, health: CoreHealth) -> bool:
        """Return whether limb states were produced since the last call, or none were expected."""
        states = health.frames.sent - health.frames.empty
        expected = sum(
            device.samples["received"]
            - sum(device.samples.get(outcome, 0) for outcome in _OUTCOMES_WITHOUT_STATE)
            for device in health.devices.values()
            if device.sensor is not None  # mocap frames produce no limb states
        )
        progressed = states > self._states or expected <= self._expected
        self._states, self._expected = states, expected
        return progressed
