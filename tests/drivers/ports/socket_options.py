"""Socket options that some systems lack, such as the user emulation of QEMU."""

from __future__ import annotations

import socket

import pytest

from jointfit_drivers.ports._socket_stamps import _TIMESTAMPNS


def _has_stamps() -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.setsockopt(socket.SOL_SOCKET, _TIMESTAMPNS, 1)
        except OSError:
            return False
    return True


needs_kernel_stamps = pytest.mark.skipif(
    not _has_stamps(), reason="this system has no stamps of network data (emulation)"
)
