"""The portable policy: its file, its network, and the forward pass in NumPy."""
