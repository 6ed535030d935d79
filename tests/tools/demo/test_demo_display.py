"""The display of the demo fits into terminals of several sizes."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import pytest
from rich.console import Console

from jointfit_daemon.tools.demo._display import STEPS, DemoDisplay
from jointfit_daemon.tools.demo._score import TrueLimbState

if TYPE_CHECKING:
    from pathlib import Path

JOINT = {
    "met": True, "source": "sensors", "predicted_error_mm": 16.66, "noise_error_mm": 2.11,
    "arc_deg": 64.2, "bends": 12,
}  # fmt: skip
POSE = {
    "joints": {
        "knee": {"flexion_deg": 60.0, "sd_deg": 2.0, "adduction_deg": -1.0, "inner_deg": 120.0}
    }
}
FIGURES = {"frames": 3000, "flexion RMSE": "1.20°", "latency": "3.2 ms"}


def shown(width: int, *, height: int = 24, frames: int = 5000) -> list[str]:
    """Return the lines of the largest display: live phase, all joints, full curves."""
    console = Console(width=width, height=height, file=io.StringIO(), force_terminal=False)
    display = DemoDisplay(headless=True, console=console)
    display.step("functional", 1.0, "")
    display.figures({"joints": {"hip": JOINT, "knee": JOINT, "ankle": JOINT}})
    display.step("live", 0.5, "15 s to go")
    for _ in range(frames):
        display.live(POSE, TrueLimbState(1, "sit_to_stand", {}, {}, 0.5), FIGURES)
    console.print(display.render())
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue().splitlines()


@pytest.mark.parametrize("width", [200, 120, 80, 60, 50])
def test_display_fits_24_lines_at_any_width(width: int) -> None:
    lines = shown(width)
    assert len(lines) <= 23  # the cursor needs line 24
    assert max(map(len, lines)) <= width
    for step in STEPS:
        assert any(step in line for line in lines)
    for what in ("flexion", "adduction", "rotation", "inner", "frames 3000"):
        assert any(what in line for line in lines), what


@pytest.mark.parametrize("width", [120, 80, 60, 50])
def test_each_curve_fills_one_line(width: int) -> None:
    curves = [line for line in shown(width) if any(bar in line for bar in "▁▂▃▄▅▆▇█")]
    assert [line.split()[1] for line in curves] == ["daemon", "truth"]
    for line in curves:
        assert sum(line.count(bar) for bar in "▁▂▃▄▅▆▇█") == width - len("│ daemon  │")


def test_display_is_saved_as_svg(tmp_path: Path) -> None:
    display = DemoDisplay(headless=True, console=Console(file=io.StringIO()))
    display.live(POSE, None, FIGURES)
    display.save(tmp_path / "demo.svg")
    assert "<svg" in (tmp_path / "demo.svg").read_text("utf-8")
