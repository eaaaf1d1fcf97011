"""``neuprim run -m``: every combination of some words, launched together and compared."""
