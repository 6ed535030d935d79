"""Geometry of limbs: rotations, chains, joint angles. Pure."""
