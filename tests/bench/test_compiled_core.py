"""Comparison of the speed of compiled modules and of their sources.

A process measures each variant. Without compiled modules, nothing is measured.
"""

from __future__ import annotations

import io
import json
from typing import TYPE_CHECKING

from bench.experiments.speed import compiled_core, core
from bench.framework.measurement import timed_result
from bench.rigs import variant_process
from jointfit_daemon.config import parse_rig
from jointfit_variant import running_variant
from tests.limb_model.plain_calibration import plain_calibration
from tests.pipeline.core_feed import table

if TYPE_CHECKING:
    import pytest

    from bench.framework.experiment import Result
    from jointfit_daemon.limb_model import Calibration


def test_a_process_reports_its_variant_and_the_times_of_each_part(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    chain = parse_rig(table()).chain
    given = [json.dumps(plain_calibration(chain).to_dict()), "clock"]
    monkeypatch.setattr("sys.stdin", io.StringIO("\n".join(given) + "\n"))
    seen: list[Calibration] = []

    def measure(quick: bool) -> list[Result]:
        assert quick
        seen.append(core.worn())
        return [timed_result("one sample", 3.0, "µs")]

    monkeypatch.setitem(variant_process.PARTS, "clock", measure)
    variant_process.main()
    variant, times = capsys.readouterr().out.splitlines()
    assert variant == running_variant()
    assert json.loads(times) == {"one sample": 3.0}
    assert seen[0].joints == chain.joints


def test_without_current_compiled_modules_nothing_is_measured(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(compiled_core, "_is_current", lambda: False)
    assert compiled_core.compiled_rows(True) == []
    assert "make compiled" in capsys.readouterr().err
