"""Writes refined markers as a chain model, an OpenSim marker set, or offsets in a TRC file.

OpenSim files have the axes of OpenSim (y up). If the import welded a body to its parent, the
markers of the body are written on the parent. Their positions in space are unchanged.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.axes import from_z_up
from jointfit_daemon.files.mocap import MarkerTrajectories, write_trc
from jointfit_daemon.files.models import write_model

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.kinematics.chains import ChainModel

ENDINGS = (".toml", ".json", ".xml", ".trc")
_OPENSIM_VERSION = "40000"
"""File format version of OpenSim 4.0."""


def write_markers(path: Path, before: ChainModel, after: ChainModel) -> None:
    """Write the markers; the file extension determines the format."""
    kind = path.suffix.lower()
    if kind == ".xml":
        root = ET.Element("OpenSimDocument", Version=_OPENSIM_VERSION)
        whole = ET.SubElement(root, "MarkerSet", name="markerset")
        objects = ET.SubElement(whole, "objects")
        for marker, at in zip(after.markers, from_z_up(after.positions), strict=True):
            found = ET.SubElement(objects, "Marker", name=marker.name)
            ET.SubElement(found, "socket_parent_frame").text = f"/bodyset/{marker.segment}"
            ET.SubElement(found, "location").text = " ".join(f"{float(v):.9g}" for v in at)
            ET.SubElement(found, "fixed").text = str(all(marker.locked)).lower()

        ET.SubElement(whole, "groups")
        ET.indent(root)
        ET.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
    elif kind == ".trc":
        # The file has one frame with the displacement of each marker, m, in segment axes.
        moved = (after.positions - before.positions)[None]
        one = np.ones(1, dtype=np.int64)
        write_trc(path, MarkerTrajectories(after.marker_names, np.zeros(1), one, moved, 1.0))
    else:
        write_model(path, after)
