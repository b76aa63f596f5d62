"""One trial, or one pack of trials, from start to end, on whichever engine."""
