"""One module for each file format; `gnrecon.io.format_registry` lists them by extension."""
