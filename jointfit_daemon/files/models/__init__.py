"""Chain models in files: the project's TOML and JSON, and OpenSim models and set-up files."""

from jointfit_daemon.files.models._chain_file import (
    as_data,
    model_of,
    read_model,
    write_model,
)
from jointfit_daemon.files.models._loaded_model import LoadedModel, load_model
from jointfit_daemon.files.models._marker_weights import read_marker_weights
from jointfit_daemon.files.models._osim import read_osim
from jointfit_daemon.files.models._osim_tasks import IkSetup, read_ik_setup

__all__ = [
    "IkSetup",
    "LoadedModel",
    "as_data",
    "load_model",
    "model_of",
    "read_ik_setup",
    "read_marker_weights",
    "read_model",
    "read_osim",
    "write_model",
]
