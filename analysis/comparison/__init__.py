"""Sweeps, or settings of them, side by side: which is better, and how sure that is."""
