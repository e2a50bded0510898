"""One question per file. `python -m experiments.NAME` measures it, and writes the result and a chart."""
