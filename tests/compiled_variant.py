"""The compiled modules in build/compiled, for tests that run a process on them."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def run_compiled(*words: str | Path, pure: bool = False) -> subprocess.CompletedProcess[str]:
    """Run Python on the tree with compiled modules, or, if `pure`, on the sources of that tree.

    Skips the test if the tree was not built from the current sources.
    """
    if not is_current():
        pytest.skip("make compiled was not run (Debian: apt install gcc python3-dev)")
    paths = [str(ROOT / "build" / "compiled"), str(ROOT)]
    return subprocess.run(
        [sys.executable, *map(str, words)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths), "JOINTFIT_PURE": str(int(pure))},
        capture_output=True, text=True, check=False, timeout=290,
    )  # fmt: skip


@cache
def is_current() -> bool:
    """Return whether build/compiled contains the current sources."""
    words = [sys.executable, str(ROOT / "packaging" / "compiled.py"), "--check"]
    return subprocess.run(words, capture_output=True, check=False).returncode == 0
