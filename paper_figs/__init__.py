"""Figures and tables of the source papers, one script each. `python -m paper_figs.NAME`."""
