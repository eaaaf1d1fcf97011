"""Single runs: train, evaluate, render, export and inspect them. Nothing here parses arguments or prints."""
