"""Marker models and their refinement: `bench/markers.py [--json FILE] [--markdown] [ID ...]`.

Measures every row of ``bench/markers_rows``; see ``bench/framework/table.py``.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the daemon's unit and its fits have it
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, from anywhere

from bench.framework import table

if __name__ == "__main__":
    sys.exit(table.main(__doc__ or "", "markers_rows")[0])
