"""Launch many runs as jobs: in this process, in other processes, on a Ray cluster or under Slurm.

This file imports nothing, so that a worker can set its number of threads before it loads anything.
"""
