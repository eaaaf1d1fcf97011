"""Built-in densities."""
