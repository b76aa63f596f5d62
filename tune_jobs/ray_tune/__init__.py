"""Everything that is Ray or Ray Tune."""
