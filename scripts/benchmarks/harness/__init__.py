"""What the benchmarks share: the command line, processes and times, pictures."""
