"""Edge-based changes of a mesh that is there: remeshing, refinement, decimation, sharpening."""
