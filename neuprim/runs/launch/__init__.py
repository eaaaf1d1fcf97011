"""Many runs at once: jobs that work in this process, in others, on a Ray cluster or under Slurm.

This file imports nothing, so that a worker can set its number of threads before it loads anything.
"""
