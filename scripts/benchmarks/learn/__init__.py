"""Shape learning: the optimisers at equal time, and one step beside nested automatic differentiation."""
