"""Centers of rotation: `bench/joint_center.py [--json FILE] [--markdown] [--plot DIR] [ID ...]`.

Measures its table; see ``bench/framework/table.py``. With ``--plot DIR`` it
also draws the real trials, one PNG each: the estimated centers beside those of the models.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, from anywhere

from bench.framework import table

if TYPE_CHECKING:
    import argparse


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--plot", type=Path, metavar="DIR", help="draw the real trials there")


def main() -> int:
    """Measure the rows, then draw if asked; return the exit code."""
    code, options = table.main(__doc__ or "", "joint_center_rows", _options)
    if options.plot is not None:
        from bench.plots.joint_centers import draw  # noqa: PLC0415 - matplotlib is optional

        for path in draw(options.plot):
            print(path, file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
