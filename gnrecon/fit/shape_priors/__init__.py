"""Priors for machine parts, made of planes, cylinders and spheres: snapping, resampling, edge and hole completion."""
