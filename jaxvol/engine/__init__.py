"""The fast engine: what `render` and its gradients run."""
