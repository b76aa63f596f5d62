"""Which hyperparameters can act: some change nothing, given the others and the length of a trial."""
