"""Where do fits fail? Parameters that images do not determine, starts from which no step leads on, noise."""

import warnings
from functools import cache

import jax.numpy as jnp
import numpy as np

import jaxvol as jv

from .entry import Entry


MARCH = jv.March(0.06, (jv.AlphaCorrection(),), "midpoint")
POINTS = 5
TRUTH = np.array([[0.9, 0.3, 0.2], [0.8, 0.5, 0.3], [0.4, 0.7, 0.4], [0.3, 0.4, 0.8], [0.6, 0.6, 0.6]])


@cache
def _waves() -> jv.Volume:
    """Values from 0 to 1 in all places of the image."""
    line = np.linspace(-1, 1, 24)
    x, y, z = np.meshgrid(line, line, line, indexing="ij")
    data = 0.5 + np.sin(3 * x + 1) * np.cos(2 * y) * np.sin(2.5 * z + 0.5) / 2
    return jv.Volume(data.astype(np.float32), [2 / 23] * 3, [-1.0] * 3)


def transfer(beyond: int, extinction: float = 1.0) -> jv.TransferFunction:
    """Five control points, the last of which (so many) lie beyond all values of the volume."""
    inside = np.linspace(0, 1, POINTS - beyond)
    values = np.concatenate([inside, 1.5 + np.arange(beyond)])
    return jv.TransferFunction(values.astype(np.float32), TRUTH, np.full(POINTS, extinction, np.float32))


def view(size: int) -> jv.Camera:
    return jv.Camera.looking_at(_waves(), (0.5, -0.9, 0.4), size=(size, size))


def image(of: jv.TransferFunction, size: int) -> np.ndarray:
    return np.asarray(jv.render(_waves(), of, view(size), MARCH, adjoint="forward").image())


def fitted(truth: np.ndarray, start: jv.TransferFunction, size: int, steps: int) -> tuple[jv.Fit, list[str]]:
    """A fit of a transfer function to one image, and what was said."""
    residual = jv.ImageResidual(_scene, [(view(size), jnp.asarray(truth))])
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = jv.fit(residual, start, max_steps=steps)
    return found, [str(warning.message) for warning in said]


def _scene(transfer: jv.TransferFunction, camera: jv.Camera) -> tuple:
    return _waves(), transfer, camera, MARCH


SIZE = 16


# -- directions that images do not determine --------------------------------------------------------------


def undetermined(beyond: float, size: int) -> dict[str, float]:
    start = transfer(int(beyond))
    found, said = fitted(image(start, SIZE), start, SIZE, 1)
    assert found.uncertainty is not None
    return {
        "undetermined": float(len(found.uncertainty.undetermined)),
        "numbers of unseen points": 4.0 * max(0, int(beyond)),
        "warning": float(any("not determined" in text for text in said)),
    }


UNDETERMINED = Entry(
    name="fits of what images do not show",
    question="What does a fit say about control points whose values the volume does not hold?",
    method="jaxvol.fit",
    regime="control points beyond all values",
    values=(0.0, 1.0, 2.0, 3.0),
    measure=undetermined,
    metric="directions",
    judged="undetermined",
    limit=0.0,
    outcome="detected and said",
    does="A warning names the parameters that the images do not determine, and their standard errors are "
    "infinite. All others are fitted as if these were not there.",
    said="warning",
    scales=("linear", "linear"),
)


# -- starts from which no step leads on -------------------------------------------------------------------


def start_from(extinction: float, size: int) -> dict[str, float]:
    truth = image(transfer(0), SIZE)
    found, _ = fitted(truth, transfer(0, extinction), SIZE, 30)
    rest = float(np.sqrt(2 * found.loss / truth.size))
    return {"RMSE after 30 steps": rest, "not converged": float(not found.success)}


STARTS = Entry(
    name="fits from opaque starts",
    question="How opaque may the start of a fit be?",
    method="jaxvol.fit",
    regime="extinction at the start / true one",
    values=(1.0, 10.0, 100.0, 1e3, 1e4, 1e5, 1e6, 1e7),
    measure=start_from,
    metric="RMSE of the fitted image",
    judged="RMSE after 30 steps",
    limit=0.001,
    does="A ray that is opaque from its first cell on shows nothing of what lies behind, and has no "
    "gradient by it: the fit ends in another minimum, or stalls. Start transparent, as jv.flat_grey "
    "does.",
)


# -- noise ------------------------------------------------------------------------------------------------

WRONG = 0.1


def noisy(deviation: float, size: int) -> dict[str, float]:
    start, rng = transfer(0), np.random.default_rng(0)
    clean = image(start, SIZE)
    found, _ = fitted(clean + deviation * rng.normal(size=clean.shape), start, SIZE, 30)
    assert found.uncertainty is not None
    exact = np.concatenate([np.ravel(start.colors), np.ravel(start.extinction)])
    seen = np.concatenate([np.ravel(found.parameters.colors), np.ravel(found.parameters.extinction)])
    errors = found.uncertainty.standard_errors
    said = np.array(
        [error for name in (".colors", ".extinction") for key, error in errors.items() if name in key]
    )
    stated = float(np.sqrt(np.mean(said**2)))
    return {
        "error": float(np.sqrt(np.mean((seen - exact) ** 2))),
        "standard error": stated,
        "stated to be beyond": float(stated > WRONG),
    }


NOISE = Entry(
    name="fits under noise",
    question="How noisy may an image be, and does the standard error say how wrong the fit is?",
    method="jaxvol.fit",
    regime="standard deviation of the noise",
    values=(1e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1),
    measure=noisy,
    metric="root mean square over colours and extinctions",
    judged="error",
    limit=WRONG,
    outcome="detected and said",
    does="Fit.uncertainty gives the standard error of each number, to first order in the noise; it is "
    "infinite, and a warning says so, where a colour that reaches 0 or 1 no longer depends on its "
    "free variable.",
    said="stated to be beyond",
)

ENTRIES = (UNDETERMINED, STARTS, NOISE)
