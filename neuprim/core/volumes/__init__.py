"""Densities on voxel grids: the model's own, and the files that it is compared with."""
