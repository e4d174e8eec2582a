"""The engine's benchmark: steps, times to a loss, memory and growth, beside the paper's algorithm written plainly."""
