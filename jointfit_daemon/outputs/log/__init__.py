"""The program's log: journal fields, rate limits, and warnings on an MQTT topic."""

from jointfit_daemon.outputs.log._journal import JournalHandler, LevelFormatter, about, is_journal
from jointfit_daemon.outputs.log._mqtt_handler import LogTopic
from jointfit_daemon.outputs.log._printable_text import PrintableRecord, printable, printable_data
from jointfit_daemon.outputs.log._rate_limit import Allowance, LimitedHandler

__all__ = [
    "Allowance",
    "JournalHandler",
    "LevelFormatter",
    "LimitedHandler",
    "LogTopic",
    "PrintableRecord",
    "about",
    "is_journal",
    "printable",
    "printable_data",
]
