"""Datasets from OpenVDB sequences: ground-truth images are ray-marched from the grids."""
