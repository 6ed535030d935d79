"""The lag's rows of the timing table, as claims."""

from __future__ import annotations

import pytest

from bench.experiment import DATA, Experiment
from bench.timing_rows import b_lag

TESTED = [row for row in b_lag.EXPERIMENTS if row.id in {"T7", "T8", "LAG-quat"}]


@pytest.mark.parametrize("row", TESTED, ids=lambda row: row.id)
def test_the_lag_keeps_its_goals(row: Experiment) -> None:
    if (why := row.missing()) is not None:
        pytest.skip(why)
    missed = [figure for figure in row.run(DATA) if not figure.kept]
    assert not missed


def test_a_tap_in_a_window_of_rest_is_no_lag() -> None:
    t_imu, q_imu, t_ref, q_ref = b_lag.made_up(1, 10.0, 5.0)
    for t, q in ((t_imu, q_imu), (t_ref, q_ref)):
        q[t < 5.0e9] = q[t < 5.0e9][-1]
        q[t > 5.25e9] = q[t > 5.25e9][0]
    found = b_lag.estimate_between(b_lag.Tracks(t_imu, q_imu, t_ref, q_ref), 0.4, 9.6)
    assert found.refused is not None
