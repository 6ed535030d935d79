"""Requests from outside: validated with every fault told, then handed to the core.

Law: nothing a stranger sends can raise; a request that is not understood is answered, not run.
"""

from __future__ import annotations

from typing import Literal

import orjson
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from jointfit_daemon.pipeline.events import Reply, Request


class CalibrateRequest(BaseModel):
    """``bridge/request/calibrate``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    transaction: str = Field("", max_length=256, description="repeated in the answer")
    phase: Literal["align", "static", "functional", "abort"] = Field(
        description="which phase begins; `abort` ends the one that runs"
    )
    seconds: float | None = Field(
        None, gt=0, le=600, description="length of the phase instead of rig.toml's, s"
    )
    force: bool = Field(False, description="replace the stored calibration even by a worse one")


COMMANDS: dict[str, type[CalibrateRequest]] = {"calibrate": CalibrateRequest}


def parse_request(command: str, payload: bytes, t_ns: int) -> Request | Reply:
    """Return the request, or the answer that says all that is wrong with it."""
    try:
        words = orjson.loads(payload or b"{}")
    except orjson.JSONDecodeError as fault:
        return _refused(command, "", "payload", f"not JSON: {fault}")
    if not isinstance(words, dict):
        return _refused(command, "", "payload", f"expected an object, got {type(words).__name__}")
    transaction = str(words.get("transaction", ""))
    model = COMMANDS.get(command)
    if model is None:
        known = ", ".join(COMMANDS)
        return _refused(command, transaction, "command", f"unknown {command!r}; known: {known}")
    try:
        asked = model.model_validate(words)
    except ValidationError as faults:
        details = faults.errors(include_url=False)
        keys = ", ".join(".".join(map(str, fault["loc"])) for fault in details)
        text = "; ".join(f"{'.'.join(map(str, f['loc']))}: {f['msg']}" for f in details)
        return _refused(command, transaction, keys, text)
    arguments = asked.model_dump(exclude={"transaction"}, exclude_none=True)
    return Request(t_ns, command, asked.transaction, arguments)


def _refused(command: str, transaction: str, key: str, message: str) -> Reply:
    error = {"key": key, "message": message}
    return Reply(command, transaction, "error", {}, error)
