"""Policies that act: load them from files, make baselines, and play, evaluate and film their episodes."""
