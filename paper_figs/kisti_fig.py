"""The KISTI report's Fig. V-1 (2005): a head and an engine under two transfer functions, shaded. Under the
first one low values are translucent and high ones opaque, under the second all visible values are opaque. The
defaults are phantoms; `--data` draws the volumes of `experiments/kisti.py`.
"""

from experiments.pictures.kisti import kisti_fig

from .common import pictures


TITLE = "KISTI report, Fig. V-1: a head and an engine under two transfer functions"
main = pictures(__doc__, "kisti_fig.webp", TITLE, kisti_fig, resolution=192, size=320)

if __name__ == "__main__":
    main()
