"""Point clouds, meshes, frames and regions, and the arithmetic on them that knows no file and no fit."""
