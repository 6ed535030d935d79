"""Samples of devices that a table in rig.toml describes: keys, layout, units and plausibility."""

from jointfit_drivers.table_samples._continuity import RecordContinuity
from jointfit_drivers.table_samples._field_settings import (
    ChecksumSettings,
    FieldSettings,
    TableImuSettings,
    check_hexadecimal,
    parts_of,
)
from jointfit_drivers.table_samples._record_samples import RecordSamples
from jointfit_drivers.table_samples._records import (
    SampleForm,
    TableRecord,
    duration_ns,
)
from jointfit_drivers.table_samples._table_form import (
    Faults,
    FieldFaultError,
    TableForm,
    binary_place,
    orientation_faults,
    overlap_faults,
    place_fields,
    sample_form,
)
from jointfit_drivers.table_samples._units import UNITS

__all__ = [
    "UNITS",
    "ChecksumSettings",
    "Faults",
    "FieldFaultError",
    "FieldSettings",
    "RecordContinuity",
    "RecordSamples",
    "SampleForm",
    "TableForm",
    "TableImuSettings",
    "TableRecord",
    "binary_place",
    "check_hexadecimal",
    "duration_ns",
    "orientation_faults",
    "overlap_faults",
    "parts_of",
    "place_fields",
    "sample_form",
]
