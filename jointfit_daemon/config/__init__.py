"""rig.toml in, a frozen `Rig` in SI out, or every fault of it at once.

Law: the only room with degrees, millimetres or file names of the rig; nothing opens here.
"""

from jointfit_daemon.config.faults import ConfigError, Fault
from jointfit_daemon.config.load import load_rig, parse_rig
from jointfit_daemon.config.rig import Rig, Source
from jointfit_daemon.config.schema import rig_schema
from jointfit_daemon.config.tables import MqttSettings, RecordingSettings, TlsSettings

__all__ = [
    "ConfigError",
    "Fault",
    "MqttSettings",
    "RecordingSettings",
    "Rig",
    "Source",
    "TlsSettings",
    "load_rig",
    "parse_rig",
    "rig_schema",
]
