"""rig.toml in, a frozen `Rig` in SI out, or every fault of it at once.

Invariant: degrees and millimetres exist in this package only; no device is opened here.
"""

from jointfit_daemon.config._checks import drifting, headings
from jointfit_daemon.config._fault_messages import ConfigError, Fault, faults_of
from jointfit_daemon.config._load import load_rig, parse_rig
from jointfit_daemon.config._rig import Rig, Source
from jointfit_daemon.config._schema import rig_schema
from jointfit_daemon.config._tables import MqttSettings, RecordingSettings, TlsSettings

__all__ = [
    "ConfigError",
    "Fault",
    "MqttSettings",
    "RecordingSettings",
    "Rig",
    "Source",
    "TlsSettings",
    "drifting",
    "faults_of",
    "headings",
    "load_rig",
    "parse_rig",
    "rig_schema",
]
