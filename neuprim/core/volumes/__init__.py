"""Extinction of a model on voxel grids and at points, and voxel files to compare it with."""
