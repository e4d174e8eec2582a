"""The engine's benchmark: steps, times to a loss, memory and growth, compared with the paper's algorithm."""
