"""Figures and tables of the source papers. `python -m paper_figs NAME` makes one of them.

Nothing is computed here. Charts and tables are drawn from the records of experiments/; pictures of scenes are
rendered by `experiments.pictures`, and the measures under a picture are of that picture, at any size.
"""
