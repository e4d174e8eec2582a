"""What a large scan costs, fitted by blocks, and whether its surface has seams."""
