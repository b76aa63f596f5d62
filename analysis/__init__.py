"""The results of a sweep: records, selection, tables, figures, report."""

from importlib import import_module

# Loading tune_jobs lets a user's own folder called analysis be imported from as well:
# see tune_jobs/process/own_packages.py.
import_module("tune_jobs")
