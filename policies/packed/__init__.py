"""Train many trials at once in one process, with their weights stacked."""
