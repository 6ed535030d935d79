"""Plots of a run: ``python -m bench.plots clocks|joint-centers FOLDER``.

The subject ``clocks`` draws a simulated run with the true clocks, or with ``--replay RECORDING`` a
recorded run of the daemon. The subject ``joint-centers`` draws the estimated joint centers of the
recorded trials and the centers of the models.
"""

from __future__ import annotations

import argparse
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.plots", description=__doc__)
    parser.add_argument("subject", choices=("clocks", "joint-centers"))
    parser.add_argument("folder", type=Path, help="folder of the PNG files")
    parser.add_argument("--replay", type=Path, metavar="RECORDING", help="draw this recorded run")
    options = parser.parse_args(words)
    if options.replay is not None and options.subject != "clocks":
        parser.error("--replay needs the subject clocks")
    return draw(options.subject, options.folder, options.replay)


def draw(subject: str, folder: Path, recorded: Path | None = None) -> int:
    """Draw one subject into `folder`, print the file names, and return the exit code."""
    if find_spec("matplotlib") is None:
        print("matplotlib is not installed: pip install 'jointfitd[plot]'", file=sys.stderr)
        return 2
    try:
        if subject == "clocks":
            written = import_module("bench.plots.clocks").run(folder, recorded)
        else:
            written = import_module("bench.plots.joint_centers").draw(folder)
    except (OSError, ValueError) as error:  # the recording is missing or unreadable
        print(error, file=sys.stderr)
        return 2
    for path in written:
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
