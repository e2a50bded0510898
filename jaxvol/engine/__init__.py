"""How are images rendered fast? What `render` runs, and what its gradients do."""
