"""Virtual wires: serial lines on pseudo-terminals (pty), CAN buses, and line noise."""

from jointfit_simulators.wires._can_wire import CanWire, PythonCanWire, SlcanAdapter
from jointfit_simulators.wires._line_noise import line_noise
from jointfit_simulators.wires._pty_line import PtyLine
from jointfit_simulators.wires._unread_input import wait_until_read

__all__ = [
    "CanWire", "PtyLine", "PythonCanWire", "SlcanAdapter", "line_noise", "wait_until_read",
]  # fmt: skip
