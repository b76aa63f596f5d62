"""Make, check, wrap, seed and draw Gymnasium environments, and handle the errors of their code."""
