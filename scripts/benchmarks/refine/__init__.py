"""Refinement of meshes beside the libraries' own remeshing and simplification."""
