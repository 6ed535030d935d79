"""What a fault scenario is, and its result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from tests.faults.gateway import Gateway

Kind = Literal["serial", "all", "host"]
"""Gateways: two serial sensors; these, a CAN sensor and cameras; with a disk and clock of its own.
"""


def nothing_missing() -> str | None:
    """Return None: the scenario runs everywhere."""
    return None


@dataclass(frozen=True, slots=True)
class Outcome:
    """One run of a scenario."""

    noticed_s: float
    """Time from the fault to its report, s."""
    recovered_s: float
    """Time from the end of the fault to the first pose as before, s."""
    pose_gap_s: float
    """Longest time between two poses meanwhile, s."""
    lost: int
    """Samples, messages or poses that were lost; the scenario names them and their counter."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """One fault, its run, and the limits of its outcome."""

    title: str
    reported: str
    """Where the fault is reported."""
    continues: str
    """What continues meanwhile."""
    counted: str
    """What is lost, and where it is counted."""
    run: Callable[[Gateway], Awaitable[Outcome]]
    noticed_limit_s: float
    recovered_limit_s: float
    recovered_median_s: float | None = None
    """Limit of the median of all runs, s."""
    gap_limit_s: float | None = None
    """Limit of the time between two poses, s; None if poses stop."""
    kind: Kind = "serial"
    """Gateway that it needs."""
    missing: Callable[[], str | None] = nothing_missing
    """Returns why it cannot run on this machine; None if it can."""

    def faults(self, outcome: Outcome, factor: float = 1.0) -> list[str]:
        """Return the limits that `outcome` exceeds; `factor` is that of a loaded machine."""
        measured = (
            ("noticed", outcome.noticed_s, self.noticed_limit_s),
            ("recovered", outcome.recovered_s, self.recovered_limit_s),
            ("longest gap of poses", outcome.pose_gap_s, self.gap_limit_s),
        )
        return [
            f"{self.title}: {name} after {value:.2f} s, limit {limit:g} s"
            for name, value, limit in measured
            if limit is not None and value > limit * factor
        ]
