"""Constants of the surface colour, shared by its CPU and GPU kernels; see :mod:`neuprim.tasks.relight.surface`."""

WRAP = 0.01  # constant under the root of s
GATE = 20.0  # slope of the gate
SHORTEST = 1e-6
"""Lower limit of the divisor when a vector is normalised, so that gradients of directions stay finite. For vectors to
light and camera, the limit is in units of the primitive's size."""
