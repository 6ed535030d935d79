"""Selection between the compiled and the interpreted form of a module.

For the modules that compute a frame, a compiled wheel contains extension modules beside the
sources (docs/speed.md).
Python imports an extension module rather than the source of the same name. With ``JOINTFIT_PURE=1``
in the environment, the packages of the project import their sources.

Invariant: both forms return the same values, bit for bit.
"""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Iterable
    from importlib.machinery import FileFinder

_PROBE = "jointfit_daemon.kinematics.rotation_scalar"
"""A module that is compiled in every compiled wheel."""

_roots: list[str] = []
"""Folders of the packages that import their sources."""


def select_variant(folders: Iterable[str]) -> None:
    """Make later imports from the package in `folders` use the sources if ``JOINTFIT_PURE`` is set.

    Called by the ``__init__`` of a package with its ``__path__``, before its other modules are
    imported.
    """
    if os.environ.get("JOINTFIT_PURE", "0") in {"", "0"}:
        return
    if not _roots:
        sys.path_hooks.insert(0, _find_sources_first)
    _roots.extend(folders)


def running_variant() -> Literal["compiled", "pure"]:
    """Return the form of the modules that this process imports."""
    from importlib.util import find_spec  # noqa: PLC0415 - on demand, it is slow to import

    spec = find_spec(_PROBE)
    source = spec is None or (spec.origin or "").endswith(".py")
    return "pure" if source else "compiled"


def _find_sources_first(folder: str) -> FileFinder:
    from importlib import machinery  # noqa: PLC0415 - needed only with JOINTFIT_PURE

    if not any(folder == root or folder.startswith(root + os.sep) for root in _roots):
        raise ImportError(f"{folder} is not a package of the project")
    return machinery.FileFinder(
        folder,
        (machinery.SourceFileLoader, machinery.SOURCE_SUFFIXES),
        (machinery.SourcelessFileLoader, machinery.BYTECODE_SUFFIXES),
        (machinery.ExtensionFileLoader, machinery.EXTENSION_SUFFIXES),
    )
