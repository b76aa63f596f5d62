"""The verbs that command line and Python share: launch, resume, extend, look up, conclude."""
