"""Fixtures of the tests of the command line."""

from fake_sweeps import run, sweeps

__all__ = ["run", "sweeps"]
