"""Validation and authentication of MQTT requests."""

from jointfit_daemon.supervisor.requests._authentication import RequestGuard
from jointfit_daemon.supervisor.requests._validation import (
    reply_correlation,
    reply_topic,
    request_of,
)

__all__ = ["RequestGuard", "reply_correlation", "reply_topic", "request_of"]
