"""Hydra's primary configuration; a package, because Hydra looks for one."""
