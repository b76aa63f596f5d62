"""Run environments outside of trials, in a child process that may hang or end without harm."""
