"""`jointfit schema`: JSON Schemas of rig.toml, payloads and requests, and the AsyncAPI document."""

from jointfit_daemon.tools.schema._command import schema

__all__ = ["schema"]
