"""Imports of optional packages."""

from __future__ import annotations

import importlib
from typing import Any

from jointfit_daemon.files.mocap import MissingPackageError


def import_extra(module: str, extra: str) -> Any:
    """Return an optional module.

    Raises
    ------
    MissingPackageError
        The package is not installed; the message names the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as missing:
        raise MissingPackageError(
            f"this format needs the package {missing.name}: pip install 'jointfitd[{extra}]'"
        ) from missing
