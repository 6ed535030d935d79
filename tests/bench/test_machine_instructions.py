"""Estimates for small computers follow from counted instructions; missing tools are named."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from bench.experiments.speed import machine_instructions

if TYPE_CHECKING:
    import pytest

PROJECT = Path(__file__).resolve().parents[2]


def test_an_estimate_is_instructions_over_clock_rate_and_instructions_per_cycle() -> None:
    found = {"x86_64": 1.5e6, "aarch64": 1.8e6}
    results = {each.name: each for each in machine_instructions._results(found)}
    ratio = results["4 × 100 Hz, bytes to pose: arm64 over x86-64"]
    assert ratio.value == 1.2
    assert ratio.met
    # 1.8 million instructions, 100 times a second, at 0.6 times 1.0 GHz
    small = results["estimate of the core, Raspberry Pi Zero 2 W (Cortex-A53, 1.0 GHz)"]
    assert small.value == 30.0
    assert small.note == "3.00 ms a frame, with 0.6 instructions per cycle"


def test_many_more_instructions_on_arm64_miss_the_threshold() -> None:
    found = {"x86_64": 1.5e6, "aarch64": 2.0e6}
    assert [each.met for each in machine_instructions._results(found)].count(False) == 1


def test_the_count_names_the_packages_that_are_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    words = [sys.executable, ".ci/machine_instructions.py", "calibration.json"]
    done = subprocess.run(words, cwd=PROJECT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "apt install" in done.stderr
    assert "qemu-user" in done.stderr
