"""Plots of one run as PNG files: clocks, delays, alignment and lags."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from bench.rigs.core_trace import traced, true_errors
from bench.subjects.simulated_clocks import SimulatedRun, simulated
from jointfit_daemon.outputs.recording import read_events

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from bench.rigs.core_trace import Look, Trace

    Floats = NDArray[np.float64]

NS, NS_PER_MS, NS_PER_US = 1e9, 1e6, 1e3
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
"""Palette of Okabe and Ito, whose colors are distinguishable with color blindness."""
GAP_PERIODS = 1.5
_DPI = 110


def run(directory: Path, recorded: Path | None) -> list[Path]:
    """Plot a recorded or a simulated run; return the written files.

    Raises
    ------
    ValueError
        The file is not a recording, or contains no sample.
    OSError
        The file cannot be read, or the plots cannot be written.
    """
    if recorded is None:
        drawn = simulated()
    else:
        drawn = SimulatedRun(list(read_events(recorded)), title=f"replayed from {recorded.name}")
    trace = traced(drawn.events)
    directory.mkdir(parents=True, exist_ok=True)
    pictures = {
        "clocks.png": clocks(trace, drawn),
        "delays.png": delays(trace, drawn),
        "alignment.png": alignment(trace, drawn),
        "lags.png": lags(trace, drawn),
    }
    written = []
    for name, figure in pictures.items():
        path = directory / name
        figure.savefig(path, dpi=_DPI)
        written.append(path)
    return written


# --- common parts ------------------------------------------------------------------------------


def _figure(
    title: str, panels: Sequence[str], about: SimulatedRun, *, height: float = 2.0
) -> Figure:
    """Return a figure with panels below each other and a common time axis."""
    figure = Figure(figsize=(11, 1.1 + height * len(panels)), layout="constrained")
    figure.suptitle(f"{title}\n{about.title}", fontsize=11, x=0.01, ha="left")
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axis, label in zip(axes, panels, strict=True):
        axis.set_ylabel(label)
        _plain(axis)
        for at_s in about.incidents.values():
            axis.axvline(at_s, color="0.45", lw=0.9, ls=":", zorder=0)
    for text, at_s in about.incidents.items():
        axes[0].annotate(
            text, (at_s, 1.0), xycoords=("data", "axes fraction"), xytext=(3, -3),
            textcoords="offset points", fontsize=8, color="0.3", va="top",
        )  # fmt: skip
    axes[-1].set_xlabel("time, s")
    return figure


def _plain(axis: Axes) -> None:
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(axis="y", color="0.9", lw=0.6)
    axis.set_axisbelow(True)


def _colors(names: Iterable[str]) -> dict[str, str]:
    return {name: COLORS[i % len(COLORS)] for i, name in enumerate(sorted(names))}


def _legend(figure: Figure, colors: dict[str, str], axis: Axes) -> None:
    for name, color in colors.items():
        axis.plot([], [], "o-", color=color, ms=4, lw=1.5, label=name)
    figure.legend(loc="upper right", ncols=len(colors), frameon=False, fontsize=9)


# --- plots -------------------------------------------------------------------------------------


def clocks(trace: Trace, about: SimulatedRun) -> Figure:
    """Draw offset, skew, sigma, jitter, rate and gaps of every stream."""
    labels = ("offset − first, ms", "skew, ppm", "sigma, µs", "jitter, ms", "rate, Hz", "gaps")
    figure = _figure("Clocks of all streams", labels, about, height=1.7)
    offset, skew, sigma, jitter, rate, gaps = figure.axes
    colors = _colors(trace.looks)
    for name, color in colors.items():
        looks = trace.looks[name]
        t_s = np.array([(look.at_ns - trace.begin_ns) / NS for look in looks])
        offset.plot(t_s, _from_first(_of(looks, "offset_ns")) / NS_PER_MS, color=color, lw=1.3)
        skew.plot(t_s, _of(looks, "skew_ppm"), color=color, lw=1.3)
        sigma.plot(t_s, _of(looks, "sigma_ns") / NS_PER_US, color=color, lw=1.3)
        jitter.plot(t_s, _of(looks, "jitter_ns") / NS_PER_MS, color=color, lw=1.3)
        if name in trace.stamps:
            _rate_and_gaps(trace, name, color, rate, gaps)
    sigma.set_yscale("log")
    offset.axhline(0.0, color="0.8", lw=0.8, zorder=0)
    gaps.set_yticks(range(len(colors)), colors)
    gaps.set_ylim(-0.6, len(colors) - 0.4)
    gaps.set_xlabel(
        "time, s      (a bar is a run of missing samples; its tick grows with their number)"
    )
    _legend(figure, colors, offset)
    return figure


def _of(looks: Sequence[Look], what: str) -> Floats:
    values = [getattr(look, what) for look in looks]
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _from_first(
    values: Floats,
) -> Floats:
    """Subtract the first known value; repeat this after each jump above 10 ms (a restart)."""
    known = np.flatnonzero(np.isfinite(values))
    found = values.copy()
    for part in np.split(known, np.flatnonzero(np.abs(np.diff(values[known])) > 1e7) + 1):
        if part.size:
            found[part] -= values[part[0]]
            found[part[0]] = np.nan  # interrupts the line at a restart of the clock
    return found


def _rate_and_gaps(trace: Trace, name: str, color: str, rate: Axes, gaps: Axes) -> None:
    t_ns = np.array([row.t_ns for row in trace.stamps[name]], dtype=np.int64)
    t_s = (t_ns - trace.begin_ns) / NS
    edges = np.arange(0.0, t_s[-1], 1.0)
    counts, _ = np.histogram(t_s, edges)
    rate.step(edges[:-1], counts, where="post", color=color, lw=1.1)
    steps = np.diff(t_ns)
    # The median step replaces the configured rate, because cameras have their own rate.
    periods = steps / np.median(steps)
    row = sorted(trace.looks).index(name)
    for i in np.flatnonzero(periods > GAP_PERIODS):
        size = min(0.42, 0.08 + 0.07 * np.log2(periods[i]))
        gaps.plot([t_s[i], t_s[i + 1]], [row, row], color=color, lw=2, solid_capstyle="butt")
        gaps.vlines(t_s[i], row - size, row + size, color=color, lw=0.9)


def delays(trace: Trace, about: SimulatedRun) -> Figure:
    """Draw arrival time minus stamp, which is the delay in excess of the minimum delay.

    For cameras whose server answers echo requests, the value is the delay since the exposure.
    """
    names = sorted(trace.stamps)
    figure = Figure(figsize=(11, 1.1 + 1.5 * len(names)), layout="constrained")
    title = f"Delay in excess of the minimum\n{about.title}"
    figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    axes = figure.subplots(
        len(names), 2, squeeze=False, sharey="row", width_ratios=(4, 1)
    )  # one scale per row: camera delays are ms, UART delays are µs
    for (over_time, spread), name in zip(axes, names, strict=True):
        color = _colors(names)[name]
        rows = trace.stamps[name]
        t_s = np.array([(row.arrival_ns - trace.begin_ns) / NS for row in rows])
        delay = np.array([(row.arrival_ns - row.t_ns) / NS_PER_MS for row in rows])
        over_time.plot(t_s, delay, ",", color=color, alpha=0.5)
        low, high = np.quantile(delay, [0.0005, 0.998])
        room = max(0.05, 0.08 * (high - low))
        over_time.set_ylim(low - room, high + room)
        over_time.set_ylabel(f"{name}, ms")
        over_time.axhline(0.0, color="0.6", lw=0.8)
        shown = delay[(delay >= low) & (delay <= high)]
        spread.hist(shown, bins=60, orientation="horizontal", color=color, alpha=0.8)
        spread.set_xticks([])
        p50, p99 = np.quantile(delay, [0.5, 0.99])
        spread.set_title(f"median {p50:.2f}, 99 % {p99:.2f}, max {delay.max():.1f} ms", fontsize=8)
        for axis in (over_time, spread):
            _plain(axis)
    axes[-1][0].set_xlabel("time, s")
    return figure


def alignment(trace: Trace, about: SimulatedRun) -> Figure:
    """Draw the error of the stamps if the truth is known, and the waiting time of the frames."""
    errors = true_errors(trace, about.taken_ns, about.unseen_ns) if about.taken_ns else {}
    panels = [f"{name}: error, ms" for name in sorted(errors)]
    note = " (error minus the minimum transport delay, which no clock observes)" if errors else ""
    figure = _figure(
        f"Alignment{note}",
        [*panels, "frame latency, ms"],
        about,
        height=1.5 if errors else 3.0,
    )
    colors = _colors(trace.stamps)
    for axis, name in zip(figure.axes, sorted(errors), strict=False):
        t_s, error, synced = errors[name]
        axis.plot(t_s[~synced], error[~synced], ".", ms=2, color="0.7", label="not synced")
        axis.plot(t_s[synced], error[synced], ".", ms=1.2, color=colors[name], label="synced")
        limit = max(0.6, 1.1 * float(np.abs(error[synced]).max(initial=0.0)))
        axis.set_ylim(-limit, limit)
        axis.axhspan(-0.5, 0.5, color=colors[name], alpha=0.07, lw=0)
        axis.set_yticks([-0.5, 0.0, 0.5])
    _latency(figure.axes[-1], trace)
    if errors:
        figure.axes[0].legend(loc="upper right", frameon=False, fontsize=8, markerscale=4, ncols=2)
    return figure


def _latency(axis: Axes, trace: Trace) -> None:
    t_s = np.array([(frame.t_ns - trace.begin_ns) / NS for frame in trace.frames])
    waited = np.array([(frame.completed_ns - frame.t_ns) / NS_PER_MS for frame in trace.frames])
    kinds: dict[str, tuple[Callable[[int], bool], str]] = {
        "settling": (lambda i: not trace.frames[i].synced, "0.7"),
        "synced": (lambda i: trace.frames[i].synced, "#0072b2"),
        "a sensor extrapolated": (lambda i: trace.frames[i].extrapolated > 0, "#e69f00"),
        "a sensor missing": (lambda i: trace.frames[i].missing > 0, "#d55e00"),
    }
    for label, (belongs, color) in kinds.items():
        which = [i for i in range(len(t_s)) if belongs(i)]
        if which:
            axis.plot(t_s[which], waited[which], ".", ms=2, color=color, label=label)
    axis.set_ylim(bottom=0.0)
    axis.legend(loc="upper right", frameon=False, fontsize=8, markerscale=4, ncols=4)


def lags(trace: Trace, about: SimulatedRun) -> Figure:
    """Draw the lag of each window with two standard deviations; crosses are rejected windows."""
    names = sorted(trace.lags)
    figure = _figure("Lag of the IMU after the cameras, windows of 10 s, ± 2 sigma",
                     [f"{name}, ms" for name in names] or ["no optical bodies"], about)  # fmt: skip
    colors = _colors(trace.stamps)
    for axis, name in zip(figure.axes, names, strict=False):
        windows = trace.lags[name]
        good = [window for window in windows if window.estimate.refused is None]
        bad = [window for window in windows if window.estimate.refused is not None]
        if good:
            axis.errorbar(
                [(window.at_ns - trace.begin_ns) / NS for window in good],
                [window.estimate.lag_ns / NS_PER_MS for window in good],
                [2 * window.estimate.sigma_ns / NS_PER_MS for window in good],
                fmt="o", ms=3.5, lw=1.1, capsize=2, color=colors[name],
                label=f"against {good[0].body.partition('/')[2]}",
            )  # fmt: skip
        low = axis.get_ylim()[0]
        at_s = [(window.at_ns - trace.begin_ns) / NS for window in bad]
        if bad:
            why = bad[0].estimate.refused
            axis.plot(at_s, [low] * len(bad), "x", color="0.5", label=f"rejected: {why}")
        if name in about.lag_ns:
            truth = (about.lag_ns[name] - trace.latency_ns[name]) / NS_PER_MS
            axis.axhline(truth, color="0.4", lw=0.9, ls="--", label="truth")
        axis.margins(y=0.3)  # room for the legend
        if good or bad:
            axis.legend(loc="upper right", frameon=False, fontsize=8, ncols=3)
    return figure
