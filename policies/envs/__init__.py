"""Make, check, wrap, seed and draw Gymnasium environments; what their code may do, and who it belongs to."""
