"""Sessions in file formats of biomechanics: export, and import for offline processing."""

from jointfit_daemon.files.sessions._formats import (
    SESSION_FORMATS,
    SESSION_SUFFIXES,
    SessionFormat,
    read_session,
    write_session,
)
from jointfit_daemon.files.sessions._written_session import NothingToWriteError, WrittenSession

__all__ = [
    "SESSION_FORMATS",
    "SESSION_SUFFIXES",
    "NothingToWriteError",
    "SessionFormat",
    "WrittenSession",
    "read_session",
    "write_session",
]
