"""Named extremes of the input space, an oracle in more than double precision, and how far each backend is from it.

``benchmarks/numerics.py`` sweeps the regions; a coarse sweep runs with the tests.
"""
