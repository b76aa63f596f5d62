"""How trials are trained."""
