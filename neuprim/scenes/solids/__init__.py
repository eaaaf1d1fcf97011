"""The scene ``solids``: a power drill and small things with sharp edges, thin parts and smooth curves."""
