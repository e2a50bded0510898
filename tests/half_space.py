"""The light reflected by an isotropically scattering half-space: closed forms, and a scene that comes close.

Chandrasekhar, Radiative Transfer, 1950.
"""

import numpy as np

import jaxvol as jv


def chandrasekhar(albedo: np.ndarray, cosine: float) -> np.ndarray:
    """Chandrasekhar's H function for isotropic scattering, by iterating its integral equation."""
    nodes, weights = np.polynomial.legendre.leggauss(64)
    nodes, weights = (nodes + 1) / 2, weights / 2
    h = np.ones((len(albedo), 64))
    root = np.sqrt(1 - albedo)[:, None]

    def iterate(mu):
        kernel = nodes / (mu[:, None] + nodes)
        return 1 / (root + (albedo[:, None] / 2) * ((h * weights) @ kernel.T))

    for _ in range(200):
        h = iterate(nodes)
    return iterate(np.asarray([cosine]))[:, 0]


def reflected(albedo: np.ndarray, cosine: float, incident: float) -> np.ndarray:
    """Radiance reflected toward `cosine` from parallel light of irradiance 1 (across its direction) at the
    cosine `incident`."""
    h = chandrasekhar(albedo, cosine) * chandrasekhar(albedo, incident)
    return albedo / (4 * np.pi) * incident / (incident + cosine) * h


def under_sky(albedo: np.ndarray, cosine: float) -> np.ndarray:
    """Radiance reflected toward `cosine` from uniform light of radiance 1."""
    return 1 - np.sqrt(1 - albedo) * chandrasekhar(albedo, cosine)


def cube(labels: np.ndarray | None = None) -> jv.Volume:
    """A constant volume with sides of length 1: with an extinction of 60, the middle of a face is like a
    half-space."""
    return jv.Volume(np.full((24,) * 3, 0.5, np.float32), (1 / 23,) * 3, labels=labels)


def far(volume: jv.Volume, height: float, size: tuple[int, int] = (20, 16), toward=(0, 0, 1)) -> jv.Camera:
    """An almost parallel view, toward +z or another direction, of a rectangle of this height around the
    centre."""
    center, toward = np.asarray(volume.center), np.asarray(toward, float)
    angle = np.rad2deg(2 * np.arctan(height / 2 / 200))
    return jv.Camera(center - 200 * toward / np.linalg.norm(toward), center, (0, 1, 0), angle, size=size)
