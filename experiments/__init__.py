"""One question a file: runs, measures, and writes its results with a chart. `python -m experiments.NAME`."""
