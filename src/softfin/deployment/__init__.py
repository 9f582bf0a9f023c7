"""Deployment: a controller on a fin that moves by itself, in real time, within safe limits. Nothing here needs JAX."""
