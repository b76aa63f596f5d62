"""Choose the points of a sweep: grid, random draws, TPE, and mutations."""
