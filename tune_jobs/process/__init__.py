"""What a run changes of the process it is in: signals, streams, names of packages."""
