"""Random sessions with gaps, and their comparison."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_daemon.session_data import (
    JointSeries,
    MarkerSeries,
    SegmentSeries,
    SensorSeries,
    SessionData,
    TimelineEvent,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array

RATES_HZ = (50.0, 59.94, 100.0, 400.0)
NAMES = st.sampled_from(["S1", "left thigh", "knee_l", "Tom:LASI", "Knie-ü"])
TEXTS = st.text("abc ,;\"'<&>ü\t", max_size=12).map(str.strip)


@st.composite
def time_axes(draw: st.DrawFn) -> Array:
    """Return a uniform axis from which some rows are missing."""
    count = draw(st.integers(8, 14))
    missing = draw(st.sets(st.integers(2, count - 2), max_size=2))
    kept = [row for row in range(count) if row not in missing]
    start_s = draw(st.sampled_from([0.0, 0.37, 12.345678, 3600.0]))
    return start_s + np.array(kept) / draw(st.sampled_from(RATES_HZ))


class _Drawing:
    """Draws random series, which all have the times `axis` if this is given."""

    def __init__(self, draw: st.DrawFn, axis: Array | None, gaps: bool) -> None:
        self.draw, self._axis, self._gaps = draw, axis, gaps
        self.rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))

    def chance(self) -> bool:
        return bool(self.draw(st.booleans()))

    def times(self) -> Array:
        return self.draw(time_axes()) if self._axis is None else self._axis

    def with_gap(self, values: Array) -> Array:
        if self._gaps and self.chance():
            values[self.rng.integers(0, len(values))] = np.nan
        return values

    def turns(self, count: int) -> Array:
        return self.with_gap(Rotation.random(count, rng=self.rng).as_quat(scalar_first=True))

    def vectors(self, count: int) -> Array | None:
        return self.with_gap(self.rng.normal(size=(count, 3))) if self.chance() else None

    def sds(self, count: int) -> Array | None:
        return self.with_gap(self.rng.uniform(0.01, 0.1, count)) if self.chance() else None

    def sensor(self, name: str) -> SensorSeries:
        t_s = self.times()
        signals = [self.vectors(len(t_s)) for _ in range(3)]
        segment = self.draw(st.sampled_from(["", "thigh"]))
        return SensorSeries(name, segment, t_s, self.turns(len(t_s)), *signals)

    def segment(self, name: str) -> SegmentSeries:
        t_s = self.times()
        return SegmentSeries(name, t_s, self.turns(len(t_s)), self.sds(len(t_s)))

    def joint(self, name: str) -> JointSeries:
        t_s = self.times()
        count = len(t_s)
        angles = {n: self.with_gap(self.rng.normal(size=count)) for n in ("flexion", "rotation")}
        sd, position = self.sds(count), self.vectors(count)
        position_sd = None if position is None else self.sds(count)
        return JointSeries(
            name, t_s, angles, {} if sd is None else {"flexion": sd}, position, position_sd
        )

    def group(self, make: Any) -> tuple[Any, ...]:
        names = self.draw(st.lists(NAMES, min_size=1, max_size=2, unique=True))
        return tuple(make(name) for name in names)

    def markers(self) -> MarkerSeries:
        t_s = self.times()
        labels = tuple(self.draw(st.lists(NAMES, min_size=1, max_size=3, unique=True)))
        positions = self.rng.normal(size=(len(t_s), len(labels), 3))
        if self._gaps:
            positions[self.rng.uniform(size=positions.shape[:2]) < 0.2] = np.nan
        return MarkerSeries(labels, t_s, positions)

    def events(self) -> tuple[TimelineEvent, ...]:
        instants = sorted(self.draw(st.lists(st.floats(0.0, 4000.0), max_size=3)))
        return tuple(
            TimelineEvent(
                round(at, 6),
                "mark",
                self.draw(st.sampled_from(["", "S1"])),
                self.draw(TEXTS),
                {"value": 1.5},
            )
            for at in instants
        )


@st.composite
def session_data(draw: st.DrawFn, *, axis: Array | None = None, gaps: bool = True) -> SessionData:
    """Return a random session, whose series all have the times `axis` if this is given."""
    drawing = _Drawing(draw, axis, gaps)
    return SessionData(
        "walk 1",
        draw(st.sampled_from([None, 1795250060351823457])),
        drawing.group(drawing.sensor),
        drawing.markers(),
        drawing.group(drawing.segment),
        drawing.group(drawing.joint),
        drawing.group(drawing.segment),
        drawing.group(drawing.joint),
        drawing.events(),
        {"rig": "bench, 1", "software": "jointfitd"},
    )


def known_rows(t_s: Array, values: Array) -> tuple[Array, Array]:
    """Return the times and values of the rows with at least one known value."""
    seen = ~np.isnan(values.reshape(len(values), -1)).all(axis=1)
    return t_s[seen], values[seen]


def assert_same_series(
    found: Any, expected: Any, precision: float, *, time_s: float = 2e-9
) -> None:
    """Compare two series; a missing row is equal to a row of unknown values."""
    slots = type(expected).__slots__
    assert type(found) is type(expected)
    for name in slots:
        left, right = getattr(found, name), getattr(expected, name)
        if name == "t_s":
            continue
        if isinstance(right, dict):
            assert left.keys() <= right.keys()
            for key in right:
                assert_same_values(
                    (found.t_s, left.get(key)), (expected.t_s, right[key]), precision, time_s
                )
        elif isinstance(right, np.ndarray) or isinstance(left, np.ndarray):
            assert_same_values((found.t_s, left), (expected.t_s, right), precision, time_s)
        else:
            assert left == right, name


def assert_same_values(found: Any, expected: Any, precision: float, time_s: float) -> None:
    (found_s, left), (expected_s, right) = found, expected
    if right is None or np.isnan(right).all():
        assert left is None or np.isnan(left).all()
        return
    left_s, left = known_rows(found_s, left)
    right_s, right = known_rows(expected_s, right)
    np.testing.assert_allclose(left_s, right_s, rtol=0.0, atol=time_s)
    np.testing.assert_allclose(left, right, rtol=precision, atol=precision)


def assert_same_group(
    found: Sequence[Any], expected: Sequence[Any], precision: float, **options: float
) -> None:
    name = "id" if isinstance(expected[0], SensorSeries) else "name"
    by_name = {getattr(series, name): series for series in found}
    assert by_name.keys() == {getattr(series, name) for series in expected}
    for series in expected:
        assert_same_series(by_name[getattr(series, name)], series, precision, **options)
