"""The cpu backend, in numba on all cores: per-primitive stage in float64, pixel stage in float32."""
