"""What the demo shows: the calibration as it goes, then the joint beside the truth.

Law: takes what it shows as arguments; on a terminal it redraws, elsewhere it prints a line a step.
"""

from __future__ import annotations

import math
import os
import sys
from collections import deque
from typing import TYPE_CHECKING, Any, Self

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from jointfit_daemon.tools.calibration_report import movement_lines

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from jointfit_daemon.tools.demo_score import Truth

WIDTH = 72
SPARSE = 10
"""Frames from one column of the curves to the next: seven seconds of 100 Hz fill the width."""
_BARS = "▁▂▃▄▅▆▇█"
STEPS = ("connect", "align", "static", "functional", "live")
_SAYS = {
    "connect": "virtual sensors, cameras and the daemon start",
    "align": "all sensors on a plate, turned by hand",
    "static": "worn; standing still",
    "functional": "moving: walk, squat, sit down, circle the hip",
    "live": "from the IMUs alone",
}


class Display:
    """The face of the demo."""

    def __init__(self, *, headless: bool, console: Console | None = None) -> None:
        self._console = console or Console(stderr=headless)
        self._live = None if headless else Live(console=self._console, refresh_per_second=10)
        self._headless = headless
        self._step, self._done, self._text = "connect", 0.0, ""
        self._said = ""
        self._joints: list[str] = []
        self._frame = 0
        self._pose: Mapping[str, Any] = {}
        self._truth: Truth | None = None
        self._figures: Mapping[str, object] = {}
        self._estimated: deque[float] = deque(maxlen=WIDTH)
        self._true: deque[float] = deque(maxlen=WIDTH)

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *ended: object) -> None:
        if self._live is not None:
            self._live.update(self.render())
            self._live.stop()

    def step(self, name: str, done: float, text: str) -> None:
        """Show how far a step is."""
        self._step, self._done, self._text = name, done, text
        if self._headless and name != self._said:
            self._said = name
            for line in self._joints:
                print(f"  {line}", file=sys.stderr)
            self._joints = []
            print(f"{name}: {_SAYS.get(name, text)}", file=sys.stderr, flush=True)
        self._draw()

    def figures(self, data: Mapping[str, Any]) -> None:
        """Show what a movement has told of the joints so far; nothing in other phases."""
        if self._step == "functional":
            self._joints = movement_lines(data)
            self._draw()

    def live(
        self, pose: Mapping[str, Any], truth: Truth | None, figures: Mapping[str, object]
    ) -> None:
        """Show the newest pose beside the truth at its instant."""
        self._pose, self._truth, self._figures = pose, truth, figures
        self._frame += 1
        flexion = _knee(pose).get("flexion_deg")
        if self._frame % SPARSE == 0 and isinstance(flexion, int | float) and truth is not None:
            self._estimated.append(float(flexion))
            self._true.append(math.degrees(truth.flexion))
        self._draw()

    def _draw(self) -> None:
        if self._live is not None:
            self._live.update(self.render())

    def save(self, path: Path) -> None:
        """Write the picture as it is now to an SVG file."""
        with open(os.devnull, "w", encoding="utf-8") as nowhere:  # noqa: PTH123 - no path
            console = Console(record=True, width=96, file=nowhere)
            console.print(self.render())
            console.save_svg(str(path), title="make demo")

    def render(self) -> Group:
        """Return the whole picture."""
        return Group(self._steps(), self._knee_panel()) if self._pose else Group(self._steps())

    def _steps(self) -> Panel:
        table = Table.grid(padding=(0, 2))
        now = STEPS.index(self._step) if self._step in STEPS else 0
        for k, name in enumerate(STEPS):
            done = 1.0 if k < now else self._done if k == now else 0.0
            style = "bold cyan" if k == now else "green" if k < now else "dim"
            mark = "✔" if k < now else "▶" if k == now else " "
            says = self._text if k == now and self._text else _SAYS[name]
            table.add_row(
                Text(f"{mark} {name}", style=style), ProgressBar(1.0, done, width=24), says
            )
        known = Text("\n".join(self._joints), style="cyan" if STEPS[now] == "functional" else "dim")
        shown = Group(table, known) if self._joints else table
        return Panel(shown, title="jointfit demo", title_align="left", border_style="cyan")

    def _knee_panel(self) -> Panel:
        knee, truth = _knee(self._pose), self._truth
        table = Table(box=None, padding=(0, 2))
        for column in ("knee", "daemon", "bones", "difference"):
            table.add_column(column, justify="right" if column != "knee" else "left")
        flexion, sd = knee.get("flexion_deg"), knee.get("sd_deg")
        true = None if truth is None else math.degrees(truth.flexion)
        difference = None if true is None or flexion is None else flexion - true
        table.add_row("flexion", f"{_deg(flexion)} ± {_deg(sd)}", _deg(true), _deg(difference, "+"))
        for name in ("adduction", "rotation", "inner"):
            table.add_row(name, _deg(knee.get(f"{name}_deg")), "", "")
        curves = Group(
            Text(f"daemon {_spark(self._estimated)}", style="cyan"),
            Text(f"bones  {_spark(self._true)}", style="green"),
        )
        figures = "   ".join(f"{key} {value}" for key, value in self._figures.items())
        motion = "" if truth is None else truth.motion
        return Panel(Group(table, curves, Text(figures, style="dim")), title=f"live · {motion}")


def _knee(pose: Mapping[str, Any]) -> dict[str, Any]:
    joints: dict[str, dict[str, Any]] = pose.get("joints") or {}
    return next((joint for joint in joints.values() if "flexion_deg" in joint), {})


def _deg(value: object, sign: str = "") -> str:
    return f"{value:{sign}.1f}°" if isinstance(value, int | float) else "—"


def _spark(values: deque[float]) -> str:
    low, high = -5.0, 110.0
    steps = len(_BARS) - 1
    return "".join(
        _BARS[round(steps * min(1.0, max(0.0, (value - low) / (high - low))))] for value in values
    )
