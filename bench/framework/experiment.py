"""Experiments and their results.

A module of ``bench.experiments`` lists its experiments in a tuple ``EXPERIMENTS``. Experiments draw
from seeded generators and read recordings, which lie beside the checkout and are never part of it.
An experiment whose recordings or packages are missing is skipped with the reason.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from math import inf
from pathlib import Path
from pkgutil import walk_packages
from typing import TYPE_CHECKING

from bench import experiments

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from bench.framework.material import Material

ALLOWED_SLOWDOWN = 4.0
"""Factor by which tests, which share the machine, may exceed the threshold of a time."""
DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
"""Folder of the recordings."""


@dataclass(frozen=True, slots=True)
class Result:
    """One measured number, the thresholds that it must keep and the target it should reach."""

    name: str
    value: float
    maximum: float = inf
    """Threshold: a larger value fails the experiment."""
    minimum: float = -inf
    """Threshold: a smaller value fails the experiment."""
    unit: str = "deg"
    target: float | None = None
    """Wanted upper limit of a time or a size; missing it is reported and fails nothing."""
    ratio: float | None = None
    """CPU time over that of a fixed loop of plain Python in the same run."""
    note: str = ""

    @property
    def met(self) -> bool:
        """Return whether the value is within its thresholds; NaN is not."""
        return self.minimum <= self.value <= self.maximum

    @property
    def threshold_text(self) -> str:
        if -self.minimum == self.maximum == inf:
            return "–"
        if self.minimum == -inf:
            return f"≤ {self.maximum:g}"
        if self.maximum == inf:
            return f"≥ {self.minimum:g}"
        return f"{self.minimum:.4g} … {self.maximum:.4g}"


@dataclass(frozen=True, slots=True)
class Experiment:
    """A deterministic measurement with thresholds, or a measurement of time."""

    id: str
    """Lower-case words joined by hyphens."""
    title: str
    run: Callable[[Path], list[Result]]
    """Function that measures, given the folder of recordings."""
    material: Material
    """Subjects and reference of the experiment."""
    recordings: tuple[str, ...] = ()
    """Folders of recordings that are read."""
    packages: tuple[str, ...] = ()
    """Packages that must be installed beside the project."""
    long: bool = False
    """Takes longer than a test may. Only `make bench-full` runs it, unless it is a headline."""
    headline: bool = False
    """Result of docs/accuracy.md, part of `make bench` although it is long."""
    timed: bool = False
    """Measures times of this machine: tests allow `ALLOWED_SLOWDOWN`."""
    quick_run: Callable[[Path], list[Result]] | None = None
    """Shorter form for `make bench`, whose results are compared with thresholds but not stored."""
    known_misses: Mapping[str, str] = field(default_factory=dict)
    """Reasons of results that miss their threshold today, by name of the result."""

    def unexpected(self, results: list[Result], *, shared_machine: bool = False) -> list[Result]:
        """Return results that miss their threshold and are not known to, most important first.

        With `shared_machine` the times of `timed` experiments may be `ALLOWED_SLOWDOWN` longer.
        """
        slack = ALLOWED_SLOWDOWN if self.timed and shared_machine else 1.0
        return [
            result
            for result in results
            if not result.minimum <= result.value <= slack * result.maximum
            and result.name not in self.known_misses
        ]

    def missing(self, data: Path = DATA) -> str | None:
        """Return why the experiment cannot run here, or None if it can."""
        absent = [name for name in self.recordings if not (data / name).is_dir()]
        if absent:
            return f"recordings not found: {', '.join(str(data / name) for name in absent)}"
        uninstalled = [name for name in self.packages if find_spec(name) is None]
        return f"not installed: {', '.join(uninstalled)}" if uninstalled else None

    @property
    def topic(self) -> str:
        """Return the package of ``bench.experiments`` that lists the experiment."""
        return _TOPICS[self.id]


_TOPICS: dict[str, str] = {}


def near(
    name: str,
    value: float,
    expected: float,
    tolerance: float,
    unit: str = "deg",
    *,
    note: str = "",
) -> Result:
    """Return a result that must be within `tolerance` of `expected`."""
    maximum, minimum = round(expected + tolerance, 9), round(expected - tolerance, 9)
    return Result(name, value, maximum, minimum, unit, note=note)


def find_experiments(topic: str = "") -> list[Experiment]:
    """Return the experiments of a package of ``bench.experiments``, or all of them."""
    found: list[Experiment] = []
    prefix = f"{experiments.__name__}."
    for info in walk_packages(experiments.__path__, prefix):
        package, _, module = info.name.removeprefix(prefix).partition(".")
        if not module or topic not in {"", package}:
            continue
        listed: tuple[Experiment, ...] = getattr(import_module(info.name), "EXPERIMENTS", ())
        _TOPICS.update((experiment.id, package) for experiment in listed)
        found += listed
    return found
