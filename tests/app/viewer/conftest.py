"""Small tiles, which are drawn at once, and a view of several of them."""

import pytest


@pytest.fixture(scope="package", autouse=True)
def side():
    """Rays along the side of a tile."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxvol.app.viewer.tiles.SIDE", 24)
        yield 24
