"""What several benchmarks need: this machine's name, timing in turns, tables, random scenes."""
