"""One module for each file format that is read or written; `gnrecon.io.format_registry` knows them by extension."""
