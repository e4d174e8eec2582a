"""Whether sigma tells the true error of a reconstruction."""
