"""Lighting of samples: light sources, and the materials that scatter their light."""

from .deferred import Deferred as Deferred
from .growth import scatterer_template as scatterer_template, scatterer_templates as scatterer_templates
from .lights import (
    ConstantLight as ConstantLight,
    DirectionalLight as DirectionalLight,
    HeadLight as HeadLight,
    Light as Light,
    PointLight as PointLight,
)
from .materials import Material as Material, material as material
from .phong import Phong as Phong
from .scatterers import ScattererTemplates as ScattererTemplates
from .shading import Lighting as Lighting
from .template import ScattererTemplate as ScattererTemplate
from .threshold import template_capacity as template_capacity
