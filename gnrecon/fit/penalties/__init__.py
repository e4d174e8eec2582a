"""Curvature penalties: smoothness, minimal surfaces in holes, developable surfaces, by Gauss-Newton steps."""
