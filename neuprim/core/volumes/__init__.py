"""Extinction of a model on voxel grids and at points, and voxel files as ground truth for the extinction."""
