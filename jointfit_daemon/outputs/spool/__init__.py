"""Spool: events and decimated poses of a broker outage, on disk until they are delivered."""

from jointfit_daemon.outputs.spool._spool import Spool, SpoolHealth
from jointfit_daemon.outputs.spool._spool_files import SpoolFiles

__all__ = ["Spool", "SpoolFiles", "SpoolHealth"]
