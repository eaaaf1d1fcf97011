"""What the commands do, for Python too: fit, measure, draw, export and inspect runs. Nothing here parses arguments."""
