"""Figures and tables of the source papers, one script each. Run `python -m paper_figs.NAME`.

Times and errors come from the records of experiments/ (`chae_fig5`, `kisti_table`, `table1`). Scripts that
show pictures or templates make them; the measures under a picture are of that picture, at any size.
"""
