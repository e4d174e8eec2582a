"""Reconstructs many scans, each in a process of its own, so that a crash affects only that scan."""
