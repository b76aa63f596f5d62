"""The command line: parse, call the verbs of `tune_jobs.sweeps.verbs`, print."""
