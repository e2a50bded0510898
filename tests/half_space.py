"""Closed forms for the light reflected by an isotropically scattering half-space (Chandrasekhar, 1950)."""

import numpy as np


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
