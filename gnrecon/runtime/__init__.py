"""The process and its surroundings: errors, files, logging, memory, threads, progress and plugins."""
