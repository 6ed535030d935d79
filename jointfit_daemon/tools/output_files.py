"""Checks of output paths before a computation starts, and atomic writing of text files."""

from __future__ import annotations

import importlib.util
import os
from typing import TYPE_CHECKING

from jointfit_daemon.tools.plotting import PlottingUnavailableError
from jointfit_daemon.tools.text_output import join_choices

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

PLOTS = (".png", ".svg", ".pdf")
"""File extensions of plots."""


def check_output(option: str, path: Path | None, endings: Sequence[str]) -> None:
    """Check that `path` can be written; None, which means that the option is absent, is valid.

    Raises
    ------
    ValueError
        The extension is unsupported, the folder is missing, `path` is a folder, or writing is not
        permitted.
    """
    if path is None:
        return
    if path.suffix.lower() not in endings:
        raise ValueError(
            f"{option} {path}: expected a file name that ends in {join_choices(endings)}"
        )

    folder = path.parent
    if not folder.is_dir():
        raise ValueError(
            f"{option} {path}: folder {str(folder)!r} does not exist: create it (mkdir -p), or"
            " choose another folder"
        )

    if path.is_dir():
        raise ValueError(f"{option} {path}: found a folder, expected a file: add a file name")
    if not os.access(path if path.exists() else folder, os.W_OK):
        raise ValueError(
            f"{option} {path}: no write permission: change the permission, or choose another folder"
        )


def check_plot(path: Path | None) -> None:
    """Check that the path of ``--plot`` can be written and that matplotlib is installed.

    Raises
    ------
    ValueError
        The errors of `check_output`.
    PlottingUnavailableError
        Matplotlib is not installed.
    """
    check_output("--plot", path, PLOTS)
    if path is not None and importlib.util.find_spec("matplotlib") is None:
        raise PlottingUnavailableError


def replace_file(path: Path, text: str) -> None:
    """Write a text file atomically; if an error occurs, the old file is unchanged."""
    partial = path.with_name(f"{path.name}.part")
    try:
        with partial.open("w", encoding="utf-8", newline="") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
