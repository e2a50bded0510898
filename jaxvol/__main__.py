"""`python -m jaxvol` runs the command `jaxvol`."""

import sys

from .app.cli import main


if __name__ == "__main__":
    sys.exit(main())
