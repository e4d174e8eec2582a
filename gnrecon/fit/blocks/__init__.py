"""The local fields of a large scan, solved by blocks of an octree: in processes, resumable, or on a cluster."""
