"""The command line: it parses, calls the functions of `tune_jobs.sweeps.verbs`, and prints."""
