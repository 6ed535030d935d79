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
REPRODUCERS = Path(__file__).parent / "reproducers"
"""One folder a target; every input in it failed once, and must not fail again."""


def reproducers(name: str) -> list[Path]:
    """Return the inputs of a target that failed once."""
    return sorted((REPRODUCERS / name).glob("*"))
