"""Numbers and names of sync lines, functions and polarities agree with the manual."""

from __future__ import annotations

import pytest

from jointfit_protocols.xbus import sync_lines
from jointfit_protocols.xbus.sync_lines import Polarity, SyncFunction, line_code, line_name


@pytest.mark.parametrize(
    ("product_code", "out"),
    [
        ("MTi-300-2A8G4", 4),
        ("MTi-G-710", 4),
        ("MTi-600-1A2G6", 7),
        ("MTi-630-8A1G6", 7),
        ("MTi-699", 7),
        ("MTi-700", 4),
        ("MTi-599", 4),
        ("Avior", 4),
    ],
)
def test_lines_have_their_numbers(product_code: str, out: int) -> None:
    found = {name: line_code(name, product_code) for name in sync_lines.LINES}
    assert found == {"clock_in": 0, "in1": 2, "in2": 9, "out1": out}
    for name, code in found.items():
        assert line_name(code) == name


def test_numbers_without_a_name_are_shown() -> None:
    assert line_name(5) == "line 5"
    assert [sync_lines.function_name(code) for code in (3, 4, 8, 9, 11, 14, 15)] == [
        "trigger_indication", "interval_transition_measurement", "send_latest",
        "clock_bias_estimation", "start_sampling", "gnss_1pps", "function 15",
    ]  # fmt: skip
    assert [sync_lines.polarity_name(code) for code in range(5)] == [
        "off", "rising", "falling", "both", "polarity 4",
    ]  # fmt: skip
    assert max(SyncFunction) == 14
    assert list(Polarity) == [1, 2, 3]
