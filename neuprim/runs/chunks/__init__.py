"""A scene fitted in chunks, each a run of its own, and joined into one model."""
