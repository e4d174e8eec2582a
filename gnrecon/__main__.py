"""``python -m gnrecon`` is the command line."""

from gnrecon.cli.app import main

if __name__ == "__main__":
    main()
