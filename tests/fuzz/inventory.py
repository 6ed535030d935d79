"""All fuzz targets and the inputs that once failed."""

from __future__ import annotations

from pathlib import Path

from tests.fuzz import (
    broker_targets,
    file_targets,
    lpms_targets,
    lsl_targets,
    mip_targets,
    table_targets,
    vectornav_targets,
    wire_targets,
)

MODULES = (
    wire_targets,
    lpms_targets,
    lsl_targets,
    mip_targets,
    table_targets,
    vectornav_targets,
    broker_targets,
    file_targets,
)
TARGETS = {target.name: target for module in MODULES for target in module.TARGETS}
_FILES = (broker_targets, file_targets)
_NO_DECODERS = ("-core", "-settings")
DECODERS = frozenset(
    target.name
    for module in MODULES
    for target in module.TARGETS
    if module not in _FILES and not target.name.endswith(_NO_DECODERS)
)
"""Targets that decode the bytes of a device. Their time per byte must be nearly constant."""
REPRODUCERS = Path(__file__).parent / "reproducers"
"""Folder with one folder for each target. Every input in it failed once and must not fail again."""


def reproducers(name: str) -> list[Path]:
    """Return the inputs of a target that failed once."""
    return sorted((REPRODUCERS / name).glob("*"))
