"""How bright is a half-space that scatters alike in all directions? Chandrasekhar, 1950."""

import numpy as np


def chandrasekhar(albedo: np.ndarray, cosine: float) -> np.ndarray:
    """His function H for isotropic scattering, by iterating its integral equation."""
    nodes, weights = np.polynomial.legendre.leggauss(64)
    nodes, weights = (nodes + 1) / 2, weights / 2
    h = np.ones((len(albedo), 64))
    root = np.sqrt(1 - albedo)[:, None]

    def next_of(mu):
        kernel = nodes / (mu[:, None] + nodes)
        return 1 / (root + (albedo[:, None] / 2) * ((h * weights) @ kernel.T))

    for _ in range(200):
        h = next_of(nodes)
    return next_of(np.asarray([cosine]))[:, 0]


def reflected(albedo: np.ndarray, cosine: float, incident: float) -> np.ndarray:
    """Radiance, seen at a cosine, under parallel light at another one, of an irradiance of 1 across it."""
    h = chandrasekhar(albedo, cosine) * chandrasekhar(albedo, incident)
    return albedo / (4 * np.pi) * incident / (incident + cosine) * h


def under_sky(albedo: np.ndarray, cosine: float) -> np.ndarray:
    """Radiance, seen at a cosine, under light of radiance 1 from all sides."""
    return 1 - np.sqrt(1 - albedo) * chandrasekhar(albedo, cosine)
