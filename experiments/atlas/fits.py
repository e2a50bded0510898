"""Where do fits fail? Parameters that images do not determine, starts from which no step leads on, noise."""

import warnings
from functools import cache

import jax.numpy as jnp
import numpy as np

import jaxvol as jv

from ..scenes import grid, on_cube
from .entry import entry, rms


MARCH = jv.March(0.06, (jv.AlphaCorrection(),), "midpoint")
POINTS = 5
TRUTH = np.array([[0.9, 0.3, 0.2], [0.8, 0.5, 0.3], [0.4, 0.7, 0.4], [0.3, 0.4, 0.8], [0.6, 0.6, 0.6]])


@cache
def _waves() -> jv.Volume:
    """Values from 0 to 1 in all places of the image."""
    x, y, z = grid(24)
    data = 0.5 + np.sin(3 * x + 1) * np.cos(2 * y) * np.sin(2.5 * z + 0.5) / 2
    return on_cube(data.astype(np.float32))


def transfer(beyond: int, extinction: float = 1.0) -> jv.TransferFunction:
    """Five control points, the last of which (so many) lie beyond all values of the volume."""
    inside = np.linspace(0, 1, POINTS - beyond)
    values = np.concatenate([inside, 1.5 + np.arange(beyond)])
    return jv.TransferFunction(values.astype(np.float32), TRUTH, np.full(POINTS, extinction, np.float32))


def view() -> jv.Camera:
    return jv.Camera.looking_at(_waves(), (0.5, -0.9, 0.4), size=(16, 16))


def image(of: jv.TransferFunction) -> np.ndarray:
    return np.asarray(jv.render(_waves(), of, view(), MARCH, adjoint="forward").image())


def fitted(truth: np.ndarray, start: jv.TransferFunction, steps: int) -> tuple[jv.Fit, list[str]]:
    """A fit of a transfer function to one image, and what was said."""
    residual = jv.ImageResidual(_scene, [(view(), jnp.asarray(truth))])
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = jv.fit(residual, start, max_steps=steps)
    return found, [str(warning.message) for warning in said]


def _scene(transfer: jv.TransferFunction, camera: jv.Camera) -> tuple:
    return _waves(), transfer, camera, MARCH


@entry(
    "jaxvol.fit",
    "control points beyond all values",
    (0.0, 1.0, 2.0, 3.0),
    "directions",
    "undetermined",
    outcome="detected and said",
    limit=0.0,
    said="warning",
)
def fits_of_what_images_do_not_show(beyond: float, size: int) -> dict[str, float]:
    """What does a fit say about control points whose values the volume does not hold?

    A warning names the parameters that the images do not determine, and their standard errors are infinite.
    All others are fitted as if these were not there."""
    start = transfer(int(beyond))
    found, said = fitted(image(start), start, 1)
    assert found.uncertainty is not None
    return {
        "undetermined": float(len(found.uncertainty.undetermined)),
        "numbers of unseen points": 4.0 * max(0, int(beyond)),
        "warning": float(any("not determined" in text for text in said)),
    }


@entry(
    "jaxvol.fit",
    "extinction at the start / true one",
    (1.0, 10.0, 100.0, 1e3, 1e4, 1e5, 1e6, 1e7),
    "RMSE of the fitted image",
    "RMSE after 30 steps",
    limit=0.001,
)
def fits_from_opaque_starts(extinction: float, size: int) -> dict[str, float]:
    """How opaque may the start of a fit be?

    A ray that is opaque from its first cell on shows nothing of what lies behind, and has no gradient by it:
    the fit ends in another minimum, or stalls. Start transparent, as jv.flat_grey does."""
    truth = image(transfer(0))
    found, _ = fitted(truth, transfer(0, extinction), 30)
    rest = float(np.sqrt(2 * found.loss / truth.size))
    return {"RMSE after 30 steps": rest, "not converged": float(not found.success)}


WRONG = 0.1


@entry(
    "jaxvol.fit",
    "standard deviation of the noise",
    (1e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1),
    "root mean square over colours and extinctions",
    "error",
    outcome="detected and said",
    limit=WRONG,
    said="stated to be beyond",
)
def fits_under_noise(deviation: float, size: int) -> dict[str, float]:
    """How noisy may an image be, and does the standard error say how wrong the fit is?

    Fit.uncertainty gives the standard error of each number, to first order in the noise; it is infinite, and
    a warning says so, where a colour that reaches 0 or 1 no longer depends on its free variable."""
    start, rng = transfer(0), np.random.default_rng(0)
    clean = image(start)
    found, _ = fitted(clean + deviation * rng.normal(size=clean.shape), start, 30)
    assert found.uncertainty is not None
    exact = np.concatenate([np.ravel(start.colors), np.ravel(start.extinction)])
    seen = np.concatenate([np.ravel(found.parameters.colors), np.ravel(found.parameters.extinction)])
    errors = found.uncertainty.standard_errors
    stated = rms([error for key, error in errors.items() if ".colors" in key or ".extinction" in key])
    return {
        "error": rms(seen - exact),
        "standard error": stated,
        "stated to be beyond": float(stated > WRONG),
    }
