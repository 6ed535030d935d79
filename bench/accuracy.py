"""The accuracy table: `python bench/accuracy.py [--json FILE] [--markdown] [ID ...]`.

Measures every row of ``bench/accuracy_rows``; see ``bench/framework/table.py``.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, from anywhere

from bench.framework import table

if __name__ == "__main__":
    sys.exit(table.main(__doc__ or "", "accuracy_rows")[0])
