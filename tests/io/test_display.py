"""Conversion from linear light to image files, and compositing over a background."""

import jax
import numpy as np
import pytest
from skimage.io import imread

import jaxvol as jv
from jaxvol.io import display


def test_srgb_and_back():
    ramp = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(jv.from_srgb(jv.to_srgb(ramp)), ramp, atol=1e-6)
    # values from the standard: mid grey, and the end of the linear segment
    known = np.resize([0.0, 0.0031308, 0.21404, 1.0], 1001)
    np.testing.assert_allclose(np.asarray(jv.to_srgb(known))[:4], [0, 0.04045, 0.5, 1], atol=1e-5)


SRGB_HALF = 0.2158605
"""Linear value of level 128 of 255."""
RGBA = np.array([[[0.2, 0.1, 0.0, 0.5], [0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0]]] * 2, np.float32)


def test_8_bit_files_hold_srgb_and_clip(tmp_path):
    image = np.zeros((2, 3, 3), np.float32)
    image[0, 1], image[1, 2] = SRGB_HALF, 7.0
    found = imread(jv.save_png(tmp_path / "deep" / "x.png", image))
    assert found[[0, 1, 0], [1, 2, 0]].tolist() == [[128] * 3, [255] * 3, [0] * 3]
    found = imread(jv.save_image(tmp_path / "x.PNG", RGBA))  # straight alpha
    straight = np.asarray(jv.to_srgb(np.array([[[0.4, 0.2, 0.0], [0, 0, 0], [1, 1, 1]]] * 2, np.float32)))
    np.testing.assert_array_equal(found[..., :3], (straight * 255).round())
    np.testing.assert_array_equal(found[0, :, 3], [128, 0, 255])
    path = jv.save_image(tmp_path / "x.jpg", np.full((2, 3, 3), SRGB_HALF))
    assert path.read_bytes()[:3] == b"\xff\xd8\xff"
    assert abs(imread(path).astype(int) - 128).max() <= 2


def test_linear_formats_keep_every_float(tmp_path):
    from tifffile import EXTRASAMPLE, TiffFile, TiffPage

    for image in (7 * RGBA[..., :3], np.array([[1.5, np.inf], [2.5, 3.0]], np.float32), RGBA):
        for ending in (".npy", ".tiff", ".tif"):
            path = jv.save_image(tmp_path / f"x{ending}", jax.device_put(image))
            found = np.load(path) if ending == ".npy" else imread(path)
            assert found.dtype == np.float32
            np.testing.assert_array_equal(found, image)
    with TiffFile(tmp_path / "x.tif") as file:  # says that colours are premultiplied
        page = file.pages[0]
        assert isinstance(page, TiffPage)
        assert page.extrasamples == (EXTRASAMPLE.ASSOCALPHA,)


COLORS = np.zeros((2, 3, 3))
BAD = {
    "no image": ("x.png", np.zeros(4), r"linear must have shape .*got \(4,\)"),
    "a rendering": ("x.png", object(), r"linear must be an array of numbers; .*rendering\.image\(\)"),
    "NaN": ("x.png", COLORS + np.nan, "linear must not be NaN; 18 of its values are"),
    "EXR": ("x.exr", COLORS, r"path: .* must end in one of \.png, .*\.npy; got .*x\.exr"),
    "opacity in JPEG": ("x.jpg", RGBA, r"and opacity must end in one of \.png, \.tif, \.tiff, \.npy;"),
    "one channel in PNG": (
        "x.png",
        np.zeros((4, 5)),
        r"path: a file of one channel must end in one of \.tif, \.tiff, \.npy; got .*x\.png",
    ),
    "a folder": ("folder.png", COLORS, r"path: .*folder\.png cannot be written \(it is a folder"),
    "in a file": ("file.txt/x.png", COLORS, r"x\.png cannot be written"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_images_and_files_are_named(case, tmp_path):
    file, image, message = BAD[case]
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "file.txt").touch()
    with pytest.raises(ValueError, match=message):
        jv.save_image(tmp_path / file, image)
    assert not (tmp_path / file).is_file()


def test_bad_paths_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"path must end in \.png; got .*x\.jpg"):
        jv.save_png(tmp_path / "x.jpg", COLORS)
    for save in (jv.save_png, jv.save_image):
        with pytest.raises(ValueError, match=r"path .* got a NumPy array of shape .* comes first"):
            save(COLORS, tmp_path / "x.png")
        with pytest.raises(ValueError, match="path must be a str or a path; got 5"):
            save(5, COLORS)
    assert list(tmp_path.iterdir()) == []


def test_image_over_a_background():
    rendering, empty = (
        jv.Rendering(*jax.device_put((rgba, np.zeros(RGBA.shape[:2], bool)))) for rgba in (RGBA, 0 * RGBA)
    )
    white = np.asarray(rendering.image((1, 1, 1)))
    np.testing.assert_allclose(white[0], [[0.7, 0.6, 0.5], [1, 1, 1], [1, 1, 1]])
    np.testing.assert_array_equal(rendering.image("white"), rendering.image())
    over = np.asarray(rendering.image(np.full((2, 3, 3), 0.5)))
    np.testing.assert_allclose(over[1], [[0.45, 0.35, 0.25], [0.5, 0.5, 0.5], [1, 1, 1]])
    for wrong, message in (
        (np.zeros((5, 3)), "background must be one colour"),
        ("whit", "background must be a colour's name, such as \"white\", or linear RGB; got 'whit'"),
        ((1, np.nan, 1), "background must be finite"),
    ):
        with pytest.raises(ValueError, match=message):
            rendering.image(wrong)
    with pytest.warns(UserWarning, match="nothing is visible, .* jaxvol.show says why"):
        empty._repr_png_()
    assert rendering._repr_png_() is not None  # without a warning


def test_images_are_shown_side_by_side_pixel_by_pixel(monkeypatch):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    monkeypatch.setattr(plt, "show", lambda: None)
    ramp = np.linspace(0, 1, 20 * 30 * 3, dtype=np.float32).reshape(20, 30, 3)
    grey = np.random.default_rng(0).random((16, 24), np.float32)
    jv.show_images({"ramp": ramp, "grey": grey, "again": ramp[::-1]}, columns=2)
    canvas = FigureCanvasAgg(plt.gcf())
    canvas.draw()
    page = np.asarray(canvas.buffer_rgba())[..., :3]
    plt.close()

    row = 20 + display.TITLE + display.GAP
    assert page.shape == (2 * row, 2 * (30 + display.GAP) + display.GAP, 3)
    for image, left, top in ((ramp, 0, 0), (grey[..., None], 1, 0), (ramp[::-1], 0, 1)):
        height, width = image.shape[:2]
        left, top = display.GAP + left * (30 + display.GAP), display.TITLE + top * row
        found = page[top : top + height, left : left + width].astype(int)
        assert np.abs(found - np.asarray(jv.to_srgb(image)) * 255).max() < 2


def test_images_that_cannot_be_shown_are_refused():
    for images, columns, told in (
        ({}, 3, "at least one image"),
        (RGBA, 3, "images must be a dict"),
        ({"a": RGBA}, 3, r"images\['a'\] must have shape"),
        ({"a": np.full((4, 4), np.nan)}, 3, "must not be NaN; 16"),
        ({"a": "head.png"}, 3, "pass rendering.image"),
        ({"a": np.zeros((4, 4))}, 0, "columns must be"),
    ):
        with pytest.raises(ValueError, match=told):
            jv.show_images(images, columns)
