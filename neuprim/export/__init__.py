"""The built-in formats of ``neuprim export``, one per file, registered in ``pyproject.toml`` as anybody's are."""
