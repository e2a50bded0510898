"""The cheapest march, lighting and storage whose image is accurate enough."""

from .plan import Part as Part, Plan as Plan, plan as plan
