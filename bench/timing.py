"""The timing table: `python bench/timing.py [--json FILE] [--markdown] [ID ...]`.

Measures its table; see ``bench/framework/table.py``. With ``--plot DIR`` it draws
the clocks of a simulated run instead, or of a recorded one (``--replay EVENTLOG``, as the daemon
writes it); rows are measured beside the pictures only where they are named.
"""

from __future__ import annotations

import argparse
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, from anywhere

from bench.framework import table


def plot_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--plot", type=Path, metavar="DIR", help="draw clocks and lags there")
    parser.add_argument(
        "--replay",
        type=Path,
        metavar="EVENTLOG",
        help="draw this run, not a simulated one",
    )


def plot(directory: Path, recorded: Path | None) -> int:
    """Draw one run into `directory`; return the exit code."""
    if find_spec("matplotlib") is None:
        print("matplotlib is not installed: pip install 'jointfitd[plot]'", file=sys.stderr)
        return 2
    draw = import_module("bench.plots.clocks")  # the table needs no matplotlib
    try:
        written = draw.run(directory, recorded)
    except (OSError, ValueError) as error:  # no such log, or none that can be read
        print(error, file=sys.stderr)
        return 2
    for path in written:
        print(path)
    return 0


def main() -> int:
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    plot_options(early)
    options, rest = early.parse_known_args()
    if options.replay is not None and options.plot is None:
        early.error("--replay is drawn: say where to with --plot DIR")
    if options.plot is None or rest:
        code, options = table.main(__doc__ or "", "timing_rows", plot_options)
        if options.plot is None:
            return code
        return max(code, plot(options.plot, options.replay))
    return plot(options.plot, options.replay)


if __name__ == "__main__":
    sys.exit(main())
