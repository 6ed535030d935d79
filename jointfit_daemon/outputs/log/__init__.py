"""The program's log: journal fields, rate limits, and warnings on an MQTT topic."""

from jointfit_daemon.outputs.log._journal import JournalHandler, LevelFormatter, about, is_journal
from jointfit_daemon.outputs.log._mqtt_handler import MqttLogHandler
from jointfit_daemon.outputs.log._printable_text import PrintableRecord, printable, printable_data
from jointfit_daemon.outputs.log._rate_limit import RateLimitedHandler, TokenBucket

__all__ = [
    "JournalHandler",
    "LevelFormatter",
    "MqttLogHandler",
    "PrintableRecord",
    "RateLimitedHandler",
    "TokenBucket",
    "about",
    "is_journal",
    "printable",
    "printable_data",
]
