"""The cpu backend, in numba on all cores. Projects primitives in float64; computes pixels in float32."""
