"""Command `jointfit center`: estimates the centre of rotation of a joint from a marker trial."""

from jointfit_daemon.tools.center._command import center

__all__ = ["center"]
