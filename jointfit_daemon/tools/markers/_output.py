"""Refined markers as files: a model of ours, OpenSim's marker set, offsets as TRC.

Law: OpenSim's axes in OpenSim's file, ours in ours. A marker of a body that was welded to another
is written on the body it is part of, which is the same place.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.mocap import MarkerTrajectories, write_trc
from jointfit_daemon.files.models import to_y_up, write_model

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.kinematics.chains import ChainModel

ENDINGS = (".toml", ".json", ".xml", ".trc")
_OPENSIM_VERSION = "40000"


def write_markers(path: Path, before: ChainModel, after: ChainModel) -> None:
    """Write by the ending of the name."""
    kind = path.suffix.lower()
    if kind == ".xml":
        _write_marker_set(path, after)
    elif kind == ".trc":
        _write_offsets(path, before, after)
    else:
        write_model(path, after)


def _write_marker_set(path: Path, model: ChainModel) -> None:
    root = ET.Element("OpenSimDocument", Version=_OPENSIM_VERSION)
    whole = ET.SubElement(root, "MarkerSet", name="markerset")
    objects = ET.SubElement(whole, "objects")
    for marker, at in zip(model.markers, to_y_up(model.positions), strict=True):
        one = ET.SubElement(objects, "Marker", name=marker.name)
        ET.SubElement(one, "socket_parent_frame").text = f"/bodyset/{marker.segment}"
        ET.SubElement(one, "location").text = " ".join(f"{float(v):.9g}" for v in at)
        ET.SubElement(one, "fixed").text = str(all(marker.locked)).lower()
    ET.SubElement(whole, "groups")
    ET.indent(root)
    ET.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def _write_offsets(path: Path, before: ChainModel, after: ChainModel) -> None:
    """Write one row: how far each marker moved, m, in its segment's axes."""
    moved = (after.positions - before.positions)[None]
    one = np.ones(1, dtype=np.int64)
    write_trc(path, MarkerTrajectories(after.marker_names, np.zeros(1), one, moved, 1.0))
