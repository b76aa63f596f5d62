"""Plan a sweep: which trials run, on which engine, and how large they get; refuse what cannot run."""
