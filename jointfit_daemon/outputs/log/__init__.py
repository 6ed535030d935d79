"""The log of the daemon: journal fields, rate limits, and warnings on an MQTT topic."""

from jointfit_daemon.outputs.log._journal import (
    JournalHandler,
    LevelFormatter,
    is_journal,
    journal_fields,
)
from jointfit_daemon.outputs.log._mqtt_handler import MqttLogHandler
from jointfit_daemon.outputs.log._printable_text import PrintableRecord, printable, printable_data
from jointfit_daemon.outputs.log._rate_limit import RateLimitedHandler

__all__ = [
    "JournalHandler",
    "LevelFormatter",
    "MqttLogHandler",
    "PrintableRecord",
    "RateLimitedHandler",
    "is_journal",
    "journal_fields",
    "printable",
    "printable_data",
]
