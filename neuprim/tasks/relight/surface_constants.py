"""Constants of the surface colour, for all its kernels: see :mod:`neuprim.tasks.relight.surface`."""

WRAP = 0.01  # constant under the root of s
GATE = 20.0  # slope of the gate
SHORTEST = 1e-6
"""Shorter vectors (to light and camera: shorter than this times the primitive's size) are divided by it instead of by
their length, so that gradients of directions stay finite."""
