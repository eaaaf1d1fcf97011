"""The ``cpu`` backend, in numba on all cores. Primitives are projected in float64, most pixels computed in float32."""
