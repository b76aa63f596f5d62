"""Policies and environments: hyperparameters, networks, evaluation, video."""
