"""A lag window in which hardly anything moves; the goals are in tests/bench/test_tables.py."""

from __future__ import annotations

from bench.experiments.timing import lag


def test_a_tap_in_a_window_of_rest_is_no_lag() -> None:
    t_imu, q_imu, t_ref, q_ref = lag.made_up(1, 10.0, 5.0)
    for t, q in ((t_imu, q_imu), (t_ref, q_ref)):
        q[t < 5.0e9] = q[t < 5.0e9][-1]
        q[t > 5.25e9] = q[t > 5.25e9][0]
    found = lag.estimate_between(lag.LagTracks(t_imu, q_imu, t_ref, q_ref), 0.4, 9.6)
    assert found.refused is not None
