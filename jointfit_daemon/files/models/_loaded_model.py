"""Chain models of any supported file, with the names of their coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from jointfit_daemon.files.models._chain_file import read_model
from jointfit_daemon.files.models._osim import read_osim
from jointfit_daemon.kinematics.chain_coordinates import JointCoordinates, default_coordinates

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.kinematics.chains import ChainModel


@dataclass(frozen=True, slots=True)
class LoadedModel:
    """Chain model of a file."""

    chain: ChainModel
    coordinates: tuple[JointCoordinates, ...]
    """Names of the coordinates of each segment. They are taken from an OpenSim model, or else
    derived from the segment name."""
    remarks: tuple[str, ...] = ()
    """Remarks on the model, such as differences from the OpenSim model."""


def load_model(path: Path) -> LoadedModel:
    """Return the chain model of a ``.toml``, ``.json`` or ``.osim`` file.

    Raises
    ------
    MalformedFileError
        The file is damaged, or its model is not supported.
    """
    if path.suffix.lower() == ".osim":
        imported = read_osim(path)
        return LoadedModel(imported.model, imported.coordinates, imported.remarks)
    chain = read_model(path)
    return LoadedModel(chain, default_coordinates(chain))
