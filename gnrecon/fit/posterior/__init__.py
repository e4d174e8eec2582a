"""The posterior of a fit: standard deviations of the surface by the Laplace approximation."""
