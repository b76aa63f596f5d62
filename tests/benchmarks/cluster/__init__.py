"""What a sweep costs its driver, how two nodes compare with one, and what follows for larger clusters."""
