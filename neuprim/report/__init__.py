"""HTML pages in a single file: reports of a run, of a sweep, and of trade-offs."""
