"""Benchmarks of gnrecon: figures that can be made again, because machine, versions, seeds and commit go with them."""
