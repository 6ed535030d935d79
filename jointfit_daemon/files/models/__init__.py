"""Chain models in files: the project's TOML and JSON, and OpenSim models."""

from jointfit_daemon.files.models._chain_file import read_model, write_model
from jointfit_daemon.files.models._osim import read_osim

__all__ = ["read_model", "read_osim", "write_model"]
