"""Lighting of samples: light sources, and the materials that scatter their light."""

from .lights import (
    ConstantLight as ConstantLight,
    DirectionalLight as DirectionalLight,
    HeadLight as HeadLight,
    Light as Light,
    PointLight as PointLight,
)
from .materials import Material as Material, mean_free_path as mean_free_path
from .phong import Phong as Phong
from .shading import Lighting as Lighting, Shading as Shading
from .simulation import (
    scatterer_template as scatterer_template,
    scatterer_templates as scatterer_templates,
)
from .template import ScattererTemplate as ScattererTemplate
from .template_lighting import ScattererTemplates as ScattererTemplates
