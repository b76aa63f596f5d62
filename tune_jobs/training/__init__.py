"""Run one trial, or one pack of trials, from start to end, on any engine."""
