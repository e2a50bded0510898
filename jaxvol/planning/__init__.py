"""The cheapest march whose image is accurate enough."""

from .plan import Plan as Plan, plan as plan
from .search import Part as Part
