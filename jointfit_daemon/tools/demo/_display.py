"""Terminal display of the demo: calibration progress, then joint angles with the ground truth.

Invariant: the display fits into 80 columns and 24 lines. Without ``--headless`` the display is
redrawn. With it, standard error receives one line per step, and one line per joint after the
functional step.
"""

from __future__ import annotations

import math
import os
import sys
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from jointfit_daemon.tools.calibrate import movement_lines

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from rich.console import ConsoleOptions, RenderResult

    from jointfit_daemon.tools.demo._score import TrueLimbState

LONGEST_CURVE = 200
"""Number of stored points of each curve. A terminal shows the newest points that fit."""
SPARSE = 10
"""Number of frames per column of the curves: 7 s at 100 Hz fill 70 columns."""
_WIDE = 76
"""Smallest width inside the border, columns, at which the steps have a progress bar."""
_STEP_COLUMNS = 12
"""Width of the step names, columns."""
_BARS = "▁▂▃▄▅▆▇█"
STEPS = ("connect", "align", "static", "functional", "live")
_DESCRIPTIONS = {
    "connect": "start simulated sensors, cameras and the daemon",
    "align": "all sensors on one plate, rotated by hand",
    "static": "sensors on the body, standing still",
    "functional": "moving all joints widely, as in a calibration",
    "live": "joint angles from the IMUs only",
}


class DemoDisplay:
    """Progress and joint angles of one demo run."""

    def __init__(self, *, headless: bool, console: Console | None = None) -> None:
        self._console = console or Console(stderr=headless)
        self._live = None if headless else Live(console=self._console, refresh_per_second=10)
        self._headless = headless
        self._step, self._done, self._text = "connect", 0.0, ""
        self._printed_step = ""
        self._joints: list[str] = []
        self._frame = 0
        self._pose: Mapping[str, Any] = {}
        self._truth: TrueLimbState | None = None
        self._figures: Mapping[str, object] = {}
        self._estimated: deque[float] = deque(maxlen=LONGEST_CURVE)
        self._true: deque[float] = deque(maxlen=LONGEST_CURVE)

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *ended: object) -> None:
        if self._live is not None:
            self._live.update(self.render())
            self._live.stop()
            if not self._console.is_terminal:
                self._console.print()  # rich leaves the cursor in the last line

    def step(self, name: str, done: float, text: str) -> None:
        """Show the progress of a step; `done` is its completed share, 0 to 1."""
        self._step, self._done, self._text = name, done, text
        if self._headless and name != self._printed_step:
            self._printed_step = name
            for line in self._joints:
                print(f"  {line}", file=sys.stderr)
            self._joints = []
            print(f"{name}: {_DESCRIPTIONS.get(name, text)}", file=sys.stderr, flush=True)
        self._draw()

    def figures(self, data: Mapping[str, Any]) -> None:
        """Show the predicted errors of the joint centres; only the functional phase has them."""
        if self._step == "functional":
            self._joints = movement_lines(data)
            self._draw()

    def live(
        self, pose: Mapping[str, Any], truth: TrueLimbState | None, figures: Mapping[str, object]
    ) -> None:
        """Show a pose and the ground truth at the time of the pose."""
        self._pose, self._truth, self._figures = pose, truth, figures
        self._frame += 1
        flexion = _main_joint(pose)[1].get("flexion_deg")
        if self._frame % SPARSE == 0 and isinstance(flexion, int | float) and truth is not None:
            self._estimated.append(float(flexion))
            self._true.append(math.degrees(truth.flexion))
        self._draw()

    def _draw(self) -> None:
        if self._live is not None:
            self._live.update(self.render())

    def save(self, path: Path) -> None:
        """Write the current display to an SVG file."""
        with open(os.devnull, "w", encoding="utf-8") as nowhere:  # noqa: PTH123 - no path
            console = Console(record=True, width=96, file=nowhere)
            console.print(self.render())
            console.save_svg(str(path), title="jointfit demo")

    def render(self) -> Group:
        """Return the complete display."""
        return Group(self._steps(), self._joint_panel()) if self._pose else Group(self._steps())

    def _steps(self) -> Panel:
        now = STEPS.index(self._step) if self._step in STEPS else 0
        known = Text(
            "\n".join(self._joints),
            style="cyan" if STEPS[now] == "functional" else "dim",
            no_wrap=True,
            overflow="ellipsis",
        )
        steps = _FittedSteps(self._step_table(now, bars=True), self._step_table(now, bars=False))
        shown = Group(steps, known) if self._joints else steps
        return Panel(shown, title="jointfit demo", title_align="left", border_style="cyan")

    def _step_table(self, now: int, *, bars: bool) -> Table:
        """Return a table with one line per step."""
        table = Table.grid(padding=(0, 2))
        table.add_column(no_wrap=True, min_width=_STEP_COLUMNS)
        if bars:
            table.add_column(no_wrap=True)

        table.add_column(no_wrap=True, overflow="ellipsis")
        for k, name in enumerate(STEPS):
            done = 1.0 if k < now else self._done if k == now else 0.0
            style = "bold cyan" if k == now else "green" if k < now else "dim"
            mark = "✔" if k < now else "▶" if k == now else " "
            text = self._text if k == now and self._text else _DESCRIPTIONS[name]
            bar = [ProgressBar(1.0, done, width=14)] if bars else []
            table.add_row(Text(f"{mark} {name}", style=style), *bar, text)

        return table

    def _joint_panel(self) -> Panel:
        (joint, angles), truth = _main_joint(self._pose), self._truth
        table = Table(box=None, padding=(0, 1))
        for column in (joint, "daemon", "truth", "difference"):
            table.add_column(column, justify="right" if column != joint else "left", no_wrap=True)

        flexion, sd = angles.get("flexion_deg"), angles.get("sd_deg")
        true = None if truth is None else math.degrees(truth.flexion)
        difference = None if true is None or flexion is None else flexion - true
        table.add_row("flexion", f"{_deg(flexion)} ± {_deg(sd)}", _deg(true), _deg(difference, "+"))
        second = "bending" if "bending_deg" in angles else "adduction"
        for name in (second, "rotation", "inner"):
            table.add_row(name, _deg(angles.get(f"{name}_deg")), "", "")

        curves = Group(
            _Curve("daemon", self._estimated, "cyan"), _Curve("truth", self._true, "green")
        )
        figures = "   ".join(f"{key} {value}" for key, value in self._figures.items())
        motion = "" if truth is None else truth.motion
        line = Text(figures, style="dim", no_wrap=True, overflow="ellipsis")
        return Panel(Group(table, curves, line), title=f"live · {motion}")


@dataclass(frozen=True, slots=True)
class _FittedSteps:
    """Step table with progress bars if the width allows them."""

    wide: Table
    narrow: Table

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield self.wide if options.max_width >= _WIDE else self.narrow


@dataclass(frozen=True, slots=True)
class _Curve:
    """Labelled line of block characters, which shows the newest values that fit."""

    name: str
    values: Iterable[float]
    style: str

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        label = f"{self.name:6} "
        room = max(1, options.max_width - len(label))
        low, high, steps = -5.0, 110.0, len(_BARS) - 1
        curve = "".join(
            _BARS[round(steps * min(1.0, max(0.0, (value - low) / (high - low))))]
            for value in [*self.values][-room:]
        )
        yield Text(label + curve, style=self.style, no_wrap=True)


def _main_joint(pose: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return name and payload of the first joint that has a flexion."""
    joints: dict[str, dict[str, Any]] = pose.get("joints") or {}
    found = ((name, joint) for name, joint in joints.items() if "flexion_deg" in joint)
    return next(found, ("joint", {}))


def _deg(value: object, sign: str = "") -> str:
    return f"{value:{sign}.1f}°" if isinstance(value, int | float) else "—"
