"""The built-in formats of ``neuprim export``, registered in ``pyproject.toml`` like those of plugins."""
