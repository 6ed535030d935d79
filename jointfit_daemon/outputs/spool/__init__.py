"""Spool: stores events and decimated poses on disk during a broker outage, until delivery."""

from jointfit_daemon.outputs.spool._spool import Spool, SpoolHealth
from jointfit_daemon.outputs.spool._spool_files import SpoolFiles

__all__ = ["Spool", "SpoolFiles", "SpoolHealth"]
