"""Sample data: files of one simulated leg for every command that reads files."""

from jointfit_simulators.sample._sample_data import write_sample

__all__ = ["write_sample"]
