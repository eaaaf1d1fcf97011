"""Many runs at once: jobs handed to an engine that exists, in this process, in others, on a Ray cluster or under Slurm.

:func:`neuprim.runs.launch.table.launch` is the door. This file imports nothing, so that a worker is told its threads
before it loads anything.
"""
