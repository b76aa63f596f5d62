"""The store of sweeps: who writes what, and how it is read back."""
