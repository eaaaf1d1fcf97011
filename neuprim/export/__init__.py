"""The built-in file formats of ``neuprim export``. ``pyproject.toml`` registers them as entry points, like plugins."""
