"""Conversion from linear light to image files, and compositing over a background."""

import jax.numpy as jnp
import numpy as np
import pytest
from skimage.io import imread

import jaxvol as jv
from jaxvol import display


def test_srgb_and_back():
    ramp = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(jv.from_srgb(jv.to_srgb(ramp)), ramp, atol=1e-6)
    # values from the standard: mid grey, and the end of the linear segment
    np.testing.assert_allclose(
        jv.to_srgb(jnp.array([0.0, 0.0031308, 0.21404, 1.0])), [0, 0.04045, 0.5, 1], atol=1e-5
    )


def test_png_holds_srgb_and_clips(tmp_path):
    image = np.zeros((2, 3, 3), np.float32)
    image[0, 1], image[1, 2] = 0.2158605, 7.0
    path = jv.save_png(tmp_path / "deep" / "x.png", image)
    found = imread(path)
    np.testing.assert_array_equal(found[0, 1], 128)
    np.testing.assert_array_equal(found[1, 2], 255)
    np.testing.assert_array_equal(found[0, 0], 0)


RGBA = np.array([[[0.2, 0.1, 0.0, 0.5], [0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0]]], np.float32)


def test_transparent_png_has_straight_alpha(tmp_path):
    found = imread(jv.save_image(tmp_path / "x.PNG", RGBA))
    straight = np.asarray(jv.to_srgb(np.array([[0.4, 0.2, 0.0], [0, 0, 0], [1, 1, 1]], np.float32)))
    np.testing.assert_array_equal(found[0, :, :3], (straight * 255).round())
    np.testing.assert_array_equal(found[0, :, 3], [128, 0, 255])


@pytest.mark.parametrize("ending", [".tif", ".tiff", ".npy"])
@pytest.mark.parametrize(
    "image", [RGBA, 7 * RGBA[..., :3], np.array([[1.5, np.inf], [2.5, 3.0]], np.float32)]
)
def test_linear_formats_keep_every_float(ending, image, tmp_path):
    path = jv.save_image(tmp_path / f"x{ending}", jnp.asarray(image))
    found = np.load(path) if ending == ".npy" else imread(path)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, image)


def test_a_tiff_says_that_its_colours_are_premultiplied(tmp_path):
    from tifffile import EXTRASAMPLE, TiffFile, TiffPage

    with TiffFile(jv.save_image(tmp_path / "x.tif", RGBA)) as file:
        page = file.pages[0]
        assert isinstance(page, TiffPage)
        assert page.extrasamples == (EXTRASAMPLE.ASSOCALPHA,)


def test_jpeg_is_jpeg(tmp_path):
    path = jv.save_image(tmp_path / "x.jpg", np.full((8, 8, 3), 0.2158605))
    assert path.read_bytes()[:3] == b"\xff\xd8\xff"
    assert abs(imread(path).astype(int) - 128).max() <= 2


BAD = {
    "no image": ("x.png", np.zeros(4), r"image for a \.png must have shape .*got \(4,\)"),
    "two channels": ("x.png", np.zeros((4, 4, 2)), r"image for a \.png must have shape .*got \(4, 4, 2\)"),
    "a rendering": ("x.png", object(), r"linear must be an array of numbers; .*rendering\.image\(\)"),
    "empty": ("x.npy", np.zeros((0, 4, 3)), "image must have shape"),
    "NaN": (
        "x.png",
        np.full((4, 4, 3), np.nan),
        "image must not be NaN or infinite; 48 of its 48 values are",
    ),
    "infinite": ("x.png", np.full((4, 4, 3), np.inf), "image must not be NaN or infinite"),
    "EXR": ("x.exr", np.zeros((4, 4, 3)), r"path: .* must end in one of \.png, .*\.npy; got .*x\.exr"),
    "none": ("x", np.zeros((4, 4, 3)), "must end in one of"),
    "opacity in JPEG": (
        "x.jpg",
        RGBA,
        r"colours and opacity must end in one of \.png, \.tif, \.tiff, \.npy;",
    ),
    "one channel in PNG": (
        "x.png",
        np.zeros((4, 5)),
        r"image for a \.png must have shape \(height, width, 3\) or \(height, width, 4\); got \(4, 5\)\. "
        r"One channel is written as \.tif or \.npy; repeat it",
    ),
    "NaN depth": ("x.npy", np.full((4, 4), np.nan), "image must not be NaN"),
    "a folder": (
        "folder.png",
        np.zeros((4, 4, 3)),
        r"path: .*folder\.png cannot be written \(it is a folder",
    ),
    "in a file": ("file.txt/x.png", np.zeros((4, 4, 3)), r"x\.png cannot be written"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_images_and_files_are_named(case, tmp_path):
    file, image, message = BAD[case]
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "file.txt").touch()
    with pytest.raises(ValueError, match=message):
        jv.save_image(tmp_path / file, image)
    assert not (tmp_path / file).is_file()


def test_save_png_writes_nothing_else(tmp_path):
    with pytest.raises(ValueError, match=r"path must end in \.png; got .*x\.jpg"):
        jv.save_png(tmp_path / "x.jpg", np.zeros((4, 4, 3)))


@pytest.mark.parametrize("save", [jv.save_png, jv.save_image])
def test_swapped_arguments_are_named(save, tmp_path):
    image = np.zeros((4, 5, 3))
    with pytest.raises(ValueError, match=r"path .* got a NumPy array of shape .* the path comes first"):
        save(image, tmp_path / "x.png")
    with pytest.raises(ValueError, match="path must be a str or a path; got 5"):
        save(5, image)
    assert list(tmp_path.iterdir()) == []


def test_image_over_a_background():
    rgba = jnp.array([[[0.2, 0.1, 0.0, 0.5], [0.0, 0.0, 0.0, 0.0]]])
    rendering = jv.Rendering(rgba, exhausted=jnp.zeros(rgba.shape[:2], bool))
    np.testing.assert_allclose(rendering.image((1, 1, 1)), [[[0.7, 0.6, 0.5], [1, 1, 1]]])
    np.testing.assert_allclose(
        rendering.image(jnp.full((1, 2, 3), 0.5)), [[[0.45, 0.35, 0.25], [0.5, 0.5, 0.5]]]
    )
    with pytest.raises(ValueError, match="background must be one colour"):
        rendering.image(jnp.zeros((5, 3)))
    with pytest.raises(ValueError, match="background must be linear RGB numbers; got 'white'"):
        rendering.image("white")
    with pytest.raises(ValueError, match="background must be finite"):
        rendering.image((1, np.nan, 1))


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


@pytest.mark.parametrize(
    ("images", "columns", "told"),
    [
        ({}, 3, "at least one image"),
        (RGBA, 3, "images must be a dict"),
        ({"a": RGBA}, 3, r"images\['a'\] must have shape"),
        ({"a": np.full((4, 4), np.nan)}, 3, "must not be NaN; 16"),
        ({"a": "head.png"}, 3, "pass rendering.image"),
        ({"a": np.zeros((4, 4))}, 0, "columns must be"),
    ],
)
def test_images_that_cannot_be_shown_are_refused(images, columns, told):
    with pytest.raises(ValueError, match=told):
        jv.show_images(images, columns)
