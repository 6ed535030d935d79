"""Validation and authentication of MQTT requests."""

from jointfit_daemon.supervisor.requests._authentication import RequestAuthenticator
from jointfit_daemon.supervisor.requests._validation import parse_request

__all__ = ["RequestAuthenticator", "parse_request"]
