"""Redundant sensors: `bench/fusion.py [--json FILE] [--markdown] [ID ...]`.

Measures its table; see ``bench/framework/table.py``. All that a method chooses
(widths, penalties, shares, claimed deviations) it chooses by leaving out blocks and trials of what
it is trained on; the rows only judge, on frames that no fit has seen.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, from anywhere

from bench.framework import table

if __name__ == "__main__":
    sys.exit(table.main(__doc__ or "", "fusion_rows")[0])
