"""Policies and environments: hyperparameters, networks, evaluation, video."""

from importlib import import_module

# Loading tune_jobs lets a user's own folder called policies be imported from as well:
# see tune_jobs/process/own_packages.py.
import_module("tune_jobs")
