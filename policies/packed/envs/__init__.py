"""The environments of all members of a pack as one vector."""
