"""Files that a command is asked to write, checked before the work and not after it."""

from __future__ import annotations

import importlib.util
import os
from typing import TYPE_CHECKING

from jointfit_daemon.tools.plotting import PlotMissing

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

PLOTS = (".png", ".svg", ".pdf")


def check_output(option: str, path: Path | None, endings: Sequence[str]) -> None:
    """Refuse a file that could not be written later; None, an option not given, passes.

    Raises
    ------
    ValueError
        Another ending, a missing folder, a folder in the file's place, no permission.
    """
    if path is None:
        return
    if path.suffix.lower() not in endings:
        listed = " or ".join(filter(None, (", ".join(endings[:-1]), endings[-1])))
        raise ValueError(f"{option} {path}: expected a name that ends in {listed}")
    folder = path.parent
    if not folder.is_dir():
        raise ValueError(
            f"{option} {path}: there is no folder {str(folder)!r}: create it (mkdir -p) or choose"
            " another"
        )
    if path.is_dir():
        raise ValueError(f"{option} {path}: is a folder, expected a file: add a file name")
    if not os.access(path if path.exists() else folder, os.W_OK):
        raise ValueError(
            f"{option} {path}: no permission to write there: change it or choose another folder"
        )


def check_plot(path: Path | None) -> None:
    """Refuse a ``--plot`` that could not be drawn later.

    Raises
    ------
    ValueError
        As `check_output`.
    PlotMissing
        Matplotlib is not installed.
    """
    check_output("--plot", path, PLOTS)
    if path is not None and importlib.util.find_spec("matplotlib") is None:
        raise PlotMissing
