"""A project's own package, of the name of one of ours; the other, `analysis`, is a folder without this file."""
