"""Point clouds, meshes, frames, regions, local PCA and signed distances; knows no file and no fit."""
