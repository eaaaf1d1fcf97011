"""Dynamic volumes: smoke and fire over time."""
