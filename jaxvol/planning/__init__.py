"""Planning of the cheapest march whose image is within a tolerance."""

from .plan import Plan as Plan, plan as plan
from .search import Part as Part
