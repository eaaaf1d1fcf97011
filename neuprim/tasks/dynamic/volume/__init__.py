"""Datasets from OpenVDB sequences: grids become a medium of light, rays through it the ground-truth images."""
