"""The command line: `app` runs it, files named `*_command.py` define the commands, the others do their work."""
