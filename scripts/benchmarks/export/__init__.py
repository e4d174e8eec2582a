"""What the extraction of a field costs, and that marching cubes on the whole grid gives the same surface."""
