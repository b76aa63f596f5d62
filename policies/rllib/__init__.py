"""Configure RLlib from hyperparameters; sampling, learners, and restoring checkpoints."""
