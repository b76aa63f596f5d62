"""Choose the points of a sweep: grid, random draws, models of the trials that ended, and mutations."""
