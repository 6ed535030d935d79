"""Classes of fault scenarios and their results."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from tests.faults.gateway import Gateway

Kind = Literal["serial", "all", "host"]
"""Kinds of gateways: two serial sensors; two serial sensors, a CAN sensor and cameras; two serial
sensors with a disk and a clock of their own.
"""


def nothing_missing() -> str | None:
    """Return None, because the scenario runs on every machine."""
    return None


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one run of a scenario."""

    noticed_s: float
    """Time from the fault to its report, s."""
    recovered_s: float
    """Time from the end of the fault until the disturbed function works as before, s. In most
    scenarios, this is the time until a pose with all sensors."""
    pose_gap_s: float
    """Longest time between two poses during the run, s."""
    lost: int
    """Number of lost samples, messages or poses, as described by `Scenario.counted`."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """One fault, its run, and the limits of its outcome."""

    title: str
    reported: str
    """Where the fault is reported."""
    continues: str
    """Functions that continue during the fault."""
    counted: str
    """Data that are lost, and the counter of the loss."""
    run: Callable[[Gateway], Awaitable[Outcome]]
    noticed_limit_s: float
    recovered_limit_s: float
    recovered_median_s: float | None = None
    """Limit of the median of all runs, s."""
    gap_limit_s: float | None = None
    """Limit of the time between two poses, s; None if poses stop."""
    kind: Kind = "serial"
    """Kind of gateway that the scenario needs."""
    missing: Callable[[], str | None] = nothing_missing
    """Returns the reason why the scenario cannot run on this machine; None if it can run."""

    def faults(self, outcome: Outcome, factor: float = 1.0) -> list[str]:
        """Return the exceeded limits; each limit is multiplied by the load factor `factor`."""
        measured = (
            ("noticed after", outcome.noticed_s, self.noticed_limit_s),
            ("recovered after", outcome.recovered_s, self.recovered_limit_s),
            ("longest time between poses", outcome.pose_gap_s, self.gap_limit_s),
        )
        return [
            f"{self.title}: {name} {value:.2f} s, limit {limit:g} s"
            for name, value, limit in measured
            if limit is not None and value > limit * factor
        ]
