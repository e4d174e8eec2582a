"""What the command line does beside reconstructing, one file for each command, each with one function that does it."""
