"""How does light fall on what is seen? Lights, and the materials that scatter it."""

from .lights import (
    ConstantLight as ConstantLight,
    DirectionalLight as DirectionalLight,
    Light as Light,
    PointLight as PointLight,
)
from .materials import Material as Material, material as material
from .path_traced import PathTraced as PathTraced
from .path_tracing import path_trace as path_trace
