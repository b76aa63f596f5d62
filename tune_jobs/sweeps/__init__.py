"""The functions that the command line and the Python API share: launch, resume, extend, look up, conclude."""
