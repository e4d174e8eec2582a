"""The report of a run: what JSON and the HTML page hold, and what a run will take."""
