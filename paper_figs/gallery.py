"""One scene after another under each kind of light: as it emits, shaded by its gradients, lit by scatterer
templates, and path traced. The defaults are phantoms; `--data` draws CT of an engine, a bonsai, a head and a
chest, and a frog's labels.

The path-traced medium is the transfer function's own: its extinction, and its colours as albedo. Templates
take one or two materials for the same values. Both have the same lights, and an exposure each: white is what
1 % of the pixels that show something exceed. Emission and Phong's shading have no unit of light; they are
shown as they are.
"""

from experiments.pictures.lee import gallery

from .common import pictures


main = pictures(__doc__, "gallery.webp", "Kinds of light", gallery, resolution=128)

if __name__ == "__main__":
    main()
