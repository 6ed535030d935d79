"""Check of payloads against their models: keys, types and units that the documentation names."""

from __future__ import annotations

from typing import Any

from pydantic import ValidationError

from jointfit_daemon.outputs.payload_models import PAYLOADS, payload_topic


def payload_fault(name: str, payload: Any) -> str | None:
    """Return the fault of a payload on a topic below the base; None if it fits its model."""
    topic = payload_topic(name)
    if topic is None:
        return f"{name}: no such topic"
    try:
        PAYLOADS[topic].model_validate(payload)
    except ValidationError as error:
        return f"{name}: {error}"
    return None
