"""A moving leg of known geometry: joints, motions, soft tissue, sensor and marker placement."""

from jointfit_simulators.body._limb import PARTS, LegGeometry
from jointfit_simulators.body._motion import MOTIONS
from jointfit_simulators.body._motion_script import Step, UnknownMotion, parse_programme
from jointfit_simulators.body._orientation import Rotation, from_wxyz, heading, to_wxyz
from jointfit_simulators.body._placement import CLUSTERS
from jointfit_simulators.body._random_signal import vector_wander
from jointfit_simulators.body._recorded_subject import Replayed
from jointfit_simulators.body._recorded_trial import read_recording
from jointfit_simulators.body._simulated_subject import SENSORS, Wearer
from jointfit_simulators.body._subject import Observation, Subject, Truth

__all__ = [
    "CLUSTERS",
    "MOTIONS",
    "PARTS",
    "SENSORS",
    "LegGeometry",
    "Observation",
    "Replayed",
    "Rotation",
    "Step",
    "Subject",
    "Truth",
    "UnknownMotion",
    "Wearer",
    "from_wxyz",
    "heading",
    "parse_programme",
    "read_recording",
    "to_wxyz",
    "vector_wander",
]
