"""Watertight meshes from point clouds."""
