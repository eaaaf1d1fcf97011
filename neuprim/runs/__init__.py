"""Train, evaluate, render, export and inspect runs (models in directories). Nothing here parses arguments or prints."""
