"""Subjects and references of experiments, as printed on the generated pages."""

from __future__ import annotations

from typing import NamedTuple


class Material(NamedTuple):
    """Subjects of an experiment and the reference of its errors."""

    subjects: str
    reference: str


SEEDED = Material("none; random numbers with a fixed seed", "true values, known by construction")
KNEE = Material(
    "1 adult (OpenCap subject 4), right leg, 4 virtual IMUs (orientations of skin-marker "
    "clusters plus recorded errors of real orientation filters, with one assignment of errors to "
    "sensors)",
    "musculoskeletal model fitted to other markers",
)
BOTH_KNEES = Material(
    "1 adult (OpenCap subject 4), both legs, 8 virtual IMUs (orientations of skin-marker "
    "clusters plus recorded errors of real orientation filters, with one assignment of errors to "
    "sensors)",
    "inverse kinematics of the subject's model without the markers of thighs and shanks",
)
EXCHANGED_KNEES = BOTH_KNEES._replace(
    subjects=BOTH_KNEES.subjects.replace("one assignment", "five assignments")
)
BOARD = Material(
    "1 IMU on a rigid board without soft tissue (BROAD, trials 02 slow and 07 fast)",
    "optical motion capture of the board",
)
OMITTED_SAMPLES = BOARD._replace(reference="samples of the recording that are not used")
LOWER_LIMBS = Material(
    "1 adult (OpenCap subject 4), 7 segments, 29 markers",
    "measured markers",
)
SIMULATED_MARKERS = Material(
    "markers simulated on the movements of 1 adult (OpenCap subject 4)",
    "simulated marker positions and joint angles",
)
OPENSIM_OPENCAP = Material(
    "1 adult (OpenCap subject 4)",
    "OpenSim's InverseKinematicsTool; only marker positions of the models are changed; all markers "
    "have the weight 1",
)
OPENSIM_GAIT = OPENSIM_OPENCAP._replace(subjects="1 adult (OpenSim gait2354)")
OPENCAP_CENTERS = OPENSIM_OPENCAP._replace(
    reference="joint centres of scaled models in the poses of OpenSim's inverse kinematics; the "
    "joints of the models move by 4 to 18 mm relative to the markers",
)
GAIT_CENTERS = OPENCAP_CENTERS._replace(subjects=OPENSIM_GAIT.subjects)
SIMULATED_CLOCKS = Material(
    "simulated device clocks, transports and movements", "clocks and movements of the simulator"
)
LIVE_RIG = Material(
    "simulated devices, the daemon and a broker as processes on one machine",
    "instants at which the simulator took the samples",
)
THIS_MACHINE = Material("the machine of the run", "CLOCK_MONOTONIC and CPU time of the process")
RECORDED_LEGS = Material(
    "1 adult (OpenCap subject 4), both legs, 8 virtual IMUs (orientations of skin-marker "
    "clusters plus recorded filter errors, with eight assignments of errors to sensors)",
    "inverse kinematics of the subject's model without the markers of thighs and shanks; "
    "computed twice, with the fitted marker positions of the model and with the marker "
    "positions of the static trial",
)


def simulated_subjects(count: int) -> Material:
    """Return the material of an experiment with `count` simulated subjects."""
    return Material(
        f"{count} simulated subjects, one per random seed, with different sensor-to-segment "
        "alignment, heading, soft-tissue artefact, markers and sensor errors",
        "true bone orientations, not available to the estimators",
    )
