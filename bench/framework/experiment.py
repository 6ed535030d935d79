"""Experiments and their results.

A module of ``bench.experiments`` lists its experiments in a tuple ``EXPERIMENTS``. Experiments use
seeded random generators and read recordings. The recordings are in a folder next to the checkout,
and never part of the checkout. If recordings or packages that an experiment needs are missing, the
experiment is skipped with the reason.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from math import inf
from pathlib import Path
from pkgutil import walk_packages
from statistics import median
from typing import TYPE_CHECKING

from bench import experiments

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from bench.framework.material import Material

ALLOWED_SLOWDOWN = 4.0
"""Factor by which a time may exceed its threshold in tests, because tests share the machine."""
DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
"""Folder of the recordings."""


@dataclass(frozen=True, slots=True)
class Result:
    """One measured number, with its thresholds and its target."""

    name: str
    value: float
    maximum: float = inf
    """Upper threshold. With a larger value, the experiment fails."""
    minimum: float = -inf
    """Lower threshold. With a smaller value, the experiment fails."""
    unit: str = "deg"
    target: float | None = None
    """Desired upper limit of a time or a size. A missed target is reported, but the experiment does
    not fail."""
    ratio: float | None = None
    """Ratio of the CPU time to the CPU time of a fixed loop of plain Python in the same run."""
    note: str = ""

    @property
    def met(self) -> bool:
        """Return whether the value is within its thresholds; False for NaN."""
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
    """Identifier of lower-case words, joined by hyphens."""
    title: str
    run: Callable[[Path], list[Result]]
    """Function that measures; its argument is the folder of recordings."""
    material: Material
    """Subjects and reference of the experiment."""
    recordings: tuple[str, ...] = ()
    """Folders of recordings that the experiment reads."""
    packages: tuple[str, ...] = ()
    """Packages that must be installed in addition to the project."""
    long: bool = False
    """Whether the experiment is too long for a test. Only `make bench-full` runs it, unless it is a
    headline."""
    headline: bool = False
    """Whether docs/accuracy.md contains the result. `make bench` then runs the experiment even if
    it is long."""
    timed: bool = False
    """Whether the experiment measures times of this machine. Tests then allow `ALLOWED_SLOWDOWN`.
    """
    quick_run: Callable[[Path], list[Result]] | None = None
    """Shorter variant for `make bench`. Its results are compared with thresholds but not stored."""
    known_misses: Mapping[str, str] = field(default_factory=dict)
    """Reasons why results currently miss their thresholds, by name of the result."""

    def unexpected(self, results: list[Result], *, shared_machine: bool = False) -> list[Result]:
        """Return the results that unexpectedly miss their thresholds, in their order.

        With `shared_machine`, the times of `timed` experiments may be `ALLOWED_SLOWDOWN` longer.
        """
        slack = ALLOWED_SLOWDOWN if self.timed and shared_machine else 1.0
        return [
            result
            for result in results
            if not result.minimum <= result.value <= slack * result.maximum
            and result.name not in self.known_misses
        ]

    def missing(self, data: Path = DATA) -> str | None:
        """Return the reason why the experiment cannot run here; None if it can."""
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


def median_and_worst(
    name: str,
    values: Sequence[float],
    unit: str = "deg",
    *,
    maximum: float = inf,
    worst_maximum: float | None = None,
) -> list[Result]:
    """Return median and worst of the values of several subjects or draws; large values are worse.

    Both must be at most `maximum`, except that `worst_maximum` replaces it for the worst value.
    """
    worst = maximum if worst_maximum is None else worst_maximum
    return [
        Result(f"{name}, median", median(values), maximum, unit=unit),
        Result(f"{name}, worst", max(values), worst, unit=unit),
    ]


def median_and_smallest(
    name: str, values: Sequence[float], unit: str = "", *, minimum: float = -inf
) -> list[Result]:
    """Return median and smallest value of several subjects or draws; small values are worse.

    The median must be at least `minimum`.
    """
    return [
        Result(f"{name}, median", median(values), minimum=minimum, unit=unit),
        Result(f"{name}, smallest", min(values), unit=unit),
    ]


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
