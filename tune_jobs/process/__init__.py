"""Change the process that runs a sweep, and restore it afterwards: signals, streams, package names."""
