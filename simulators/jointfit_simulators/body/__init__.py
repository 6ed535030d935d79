"""Moving limbs of known geometry: joints, motions, soft tissue, sensors and markers."""

from jointfit_simulators.body._chain_model import (
    leg_parts,
    misplaced_markers,
    model_osim,
    model_toml,
)
from jointfit_simulators.body._limb import PARTS, LegGeometry
from jointfit_simulators.body._limb_kind import RigChain
from jointfit_simulators.body._limb_kinds import LEG_CHAIN, LIMBS, SENSORS
from jointfit_simulators.body._motion import MOTIONS
from jointfit_simulators.body._motion_script import Step, UnknownMotionError, parse_motion_script
from jointfit_simulators.body._orientation import Rotation, from_wxyz, heading, to_wxyz
from jointfit_simulators.body._placement import CLUSTERS
from jointfit_simulators.body._random_signal import random_vector_signal
from jointfit_simulators.body._recorded_subject import RecordedSubject
from jointfit_simulators.body._recorded_trial import read_recorded_trial
from jointfit_simulators.body._simulated_subject import SimulatedSubject
from jointfit_simulators.body._subject import GroundTruth, InstrumentedSubject, Observation

__all__ = [
    "CLUSTERS",
    "LEG_CHAIN",
    "LIMBS",
    "MOTIONS",
    "PARTS",
    "SENSORS",
    "GroundTruth",
    "InstrumentedSubject",
    "LegGeometry",
    "Observation",
    "RecordedSubject",
    "RigChain",
    "Rotation",
    "SimulatedSubject",
    "Step",
    "UnknownMotionError",
    "from_wxyz",
    "heading",
    "leg_parts",
    "misplaced_markers",
    "model_osim",
    "model_toml",
    "parse_motion_script",
    "random_vector_signal",
    "read_recorded_trial",
    "to_wxyz",
]
