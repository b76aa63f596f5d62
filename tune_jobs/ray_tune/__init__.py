"""Everything that uses Ray Core or Ray Tune."""

from tune_jobs.process.home import name_a_home

# This comes before anything of Ray is imported.
name_a_home()
