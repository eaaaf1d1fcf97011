"""Numba backend: float64 preparation per primitive, float32 pixels, all cores."""
