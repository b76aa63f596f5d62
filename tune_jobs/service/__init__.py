"""The service: a queue of sweeps, their drivers, and the same verbs over HTTP."""
