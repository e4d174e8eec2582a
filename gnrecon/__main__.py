"""``python -m gnrecon`` is the command line."""

from gnrecon.cli import main

if __name__ == "__main__":
    main()
