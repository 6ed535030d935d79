"""Configuration: converts rig.toml to a frozen `Rig` in SI units, or reports all its faults.

Degrees and millimetres of rig.toml are converted to radians and metres here. Invariant: no device
is opened.
"""

from jointfit_daemon.config._checks import (
    drifting_imus,
    heading_warning,
    missing_files,
    rig_warnings,
)
from jointfit_daemon.config._fault_messages import ConfigError, Fault, faults_of
from jointfit_daemon.config._load import load_rig, parse_rig
from jointfit_daemon.config._open_places import LATER
from jointfit_daemon.config._rig import Rig, Source
from jointfit_daemon.config._schema import rig_schema
from jointfit_daemon.config._tables import (
    DEFAULT_STORE,
    LslSettings,
    MetricsSettings,
    MqttSettings,
    RecordingSettings,
    TlsSettings,
    is_this_host,
)

__all__ = [
    "DEFAULT_STORE",
    "LATER",
    "ConfigError",
    "Fault",
    "LslSettings",
    "MetricsSettings",
    "MqttSettings",
    "RecordingSettings",
    "Rig",
    "Source",
    "TlsSettings",
    "drifting_imus",
    "faults_of",
    "heading_warning",
    "is_this_host",
    "load_rig",
    "missing_files",
    "parse_rig",
    "rig_schema",
    "rig_warnings",
]
