"""Kinematics of limbs: rotations, joint angles, chain models, inverse kinematics."""
