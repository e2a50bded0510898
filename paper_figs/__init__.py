"""Figures and tables of the source papers, one script each. Run `python -m paper_figs.NAME`."""
