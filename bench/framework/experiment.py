"""What a row of an accuracy table is made of.

A module of a folder ``bench/*_rows`` has a tuple ``EXPERIMENTS``; nothing else is asked of it. Each
experiment is deterministic: it draws from seeded generators and reads recordings, which lie beside
the project and not in it. Where they are not, or a package only this bench needs is not installed,
the row says so and is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

BUSY = 4.0
"""A machine that does other things, too, may take so many times as long."""
DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured number and what it must keep."""

    name: str
    value: float
    goal: float
    """The value must not be above it."""
    least: float = -float("inf")
    """Nor below this."""
    unit: str = "deg"

    @property
    def kept(self) -> bool:
        return self.least <= self.value <= self.goal

    @property
    def goal_text(self) -> str:
        if -self.least == self.goal == float("inf"):
            return "–"
        if self.least == -float("inf"):
            return f"≤ {self.goal:g}"
        return (
            f"{self.least:.4g} … {self.goal:.4g}"
            if self.goal < float("inf")
            else f"≥ {self.least:g}"
        )


@dataclass(frozen=True, slots=True)
class Experiment:
    """One row."""

    id: str
    title: str
    run: Callable[[Path], list[Figure]]
    """Given the folder of recordings, measures."""
    recordings: tuple[str, ...] = ()
    """Folders it reads there."""
    packages: tuple[str, ...] = ()
    """What must be installed beside the project."""
    long: bool = False
    """Takes longer than a test may: a shorter one stands for it among the tests."""
    timed: bool = False
    """Measures times of this machine: tests, which do not have it alone, allow `BUSY` times."""

    def missed(self, figures: list[Figure]) -> list[Figure]:
        """Return the figures whose goals a test must not let pass."""
        slack = BUSY if self.timed else 1.0
        return [f for f in figures if not f.least <= f.value <= slack * f.goal]

    def missing(self, data: Path = DATA) -> str | None:
        """Say what keeps this experiment from running; None if nothing does."""
        absent = [name for name in self.recordings if not (data / name).is_dir()]
        if absent:
            return f"recordings are not here: {', '.join(str(data / name) for name in absent)}"
        uninstalled = [name for name in self.packages if find_spec(name) is None]
        return f"not installed: {', '.join(uninstalled)}" if uninstalled else None


def near(name: str, value: float, expected: float, tolerance: float, unit: str = "deg") -> Figure:
    """A figure that must reproduce another one."""
    return Figure(name, value, round(expected + tolerance, 9), round(expected - tolerance, 9), unit)


TABLES = {
    "accuracy_rows": (
        "registration.static_and_plate",
        "fusion.knee_joint",
        "fusion.knee_segments",
        "fusion.algebra",
        "end_to_end.recorded_trials",
        "fusion.simulated_leg",
        "markers.daemon_refinement",
    ),
    "fusion_rows": (
        "fusion.both_legs",
        "fusion.recorded_movements",
        "fusion.simulated_subjects",
        "sensor_faults.loss_slip_drift",
        "sensor_faults.magnetic_disturbance",
        "fusion.online_learning",
        "registration.gateway_orientation",
    ),
    "joint_center_rows": (
        "joint_center.planar",
        "joint_center.planar_oriented",
        "joint_center.spatial",
        "joint_center.published_study",
        "joint_center.real_trials",
    ),
    "markers_rows": ("markers.kinematics", "markers.refinement", "markers.opensim"),
    "timing_rows": (
        "timing.clocks",
        "timing.lag",
        "timing.lag_tracking",
        "timing.lag_plate",
        "timing.alignment",
        "timing.memory",
        "timing.live_rig",
    ),
}
"""Modules of ``bench.experiments``, by table and in its order."""


def find_experiments(table: str = "accuracy_rows") -> list[Experiment]:
    """Return all experiments of one of `TABLES`, in order of module and place."""
    found: list[Experiment] = []
    for module in TABLES[table]:
        found += import_module(f"bench.experiments.{module}").EXPERIMENTS
    return found
