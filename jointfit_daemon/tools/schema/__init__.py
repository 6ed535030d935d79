"""Command `jointfit schema`: prints JSON Schemas, and the AsyncAPI document."""

from jointfit_daemon.tools.schema._command import schema

__all__ = ["schema"]
