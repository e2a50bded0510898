"""The cheapest march whose image is accurate enough."""

from .leaps import FastestLeaping as FastestLeaping, fastest_leaping as fastest_leaping
from .plan import Plan as Plan, plan as plan
from .search import Part as Part
