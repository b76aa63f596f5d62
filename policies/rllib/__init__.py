"""Hyperparameters as RLlib configurations; sampling, learners, and checkpoints restored."""
