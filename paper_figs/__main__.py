"""Makes a figure or table: `python -m paper_figs NAME`; `--help` after the name tells its options."""

import sys

from .index import FIGURES


name, *options = sys.argv[1:] or [""]
if name not in FIGURES:
    raise SystemExit(f"NAME must be one of {', '.join(FIGURES)}; got {name!r}.")
FIGURES[name](options)
