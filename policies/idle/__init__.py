"""Find idle hyperparameters, which change nothing, given the others and the length of a trial."""
