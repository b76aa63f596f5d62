"""What a sweep left behind: records, selection, tables, figures, report."""

from importlib import import_module

# Which settles that a user's own folder called analysis can be imported from as well:
# see tune_jobs/process/own_packages.py.
import_module("tune_jobs")
