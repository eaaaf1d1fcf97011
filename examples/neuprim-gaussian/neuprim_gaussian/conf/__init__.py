"""Hydra groups of the task; a package because Hydra looks for one."""
