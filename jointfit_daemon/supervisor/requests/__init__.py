"""Requests of MQTT clients: definition, validation, authentication, and single execution."""

from jointfit_daemon.supervisor.requests._arguments import REQUESTS, RequestArguments, RequestKind
from jointfit_daemon.supervisor.requests._authentication import RequestAuthenticator
from jointfit_daemon.supervisor.requests._dispatcher import Handler, RequestDispatcher
from jointfit_daemon.supervisor.requests._validation import error_of, parse_request

__all__ = [
    "REQUESTS",
    "Handler",
    "RequestArguments",
    "RequestAuthenticator",
    "RequestDispatcher",
    "RequestKind",
    "error_of",
    "parse_request",
]
