"""Hydra groups of the static task; a package, because Hydra looks for one."""
