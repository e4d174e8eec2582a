"""Local fields of large scans, solved by blocks of an octree: in processes or on a cluster, and resumable."""
