"""Everything that uses Ray Core or Ray Tune."""
