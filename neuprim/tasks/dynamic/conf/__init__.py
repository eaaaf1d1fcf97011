"""Hydra groups of the dynamic task; a package, because Hydra looks for one."""
