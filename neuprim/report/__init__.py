"""HTML pages that stand alone: the report of a run, of a sweep, of trade-offs."""
