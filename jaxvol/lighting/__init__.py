"""How does light fall on what is seen? Lights, and the materials that scatter it."""

from .deferred import Deferred as Deferred
from .lights import (
    ConstantLight as ConstantLight,
    DirectionalLight as DirectionalLight,
    Light as Light,
    PointLight as PointLight,
)
from .materials import Material as Material, material as material
from .path_traced import PathTraced as PathTraced
from .path_tracing import path_trace as path_trace
from .scatterers import ScattererTemplates as ScattererTemplates
from .seam import Lighting as Lighting
from .template import (
    ScattererTemplate as ScattererTemplate,
    scatterer_template as scatterer_template,
    scatterer_templates as scatterer_templates,
    template_capacity as template_capacity,
)
