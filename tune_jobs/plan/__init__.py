"""What will run, on which engine, how large; refuses what cannot."""
