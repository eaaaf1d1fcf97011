"""Datasets from OpenVDB sequences: a medium of their grids, ray-marched to ground truth."""
