"""The command line against sweeps that are made up, as in tests/unit."""

from fake_sweeps import run, sweeps

__all__ = ["run", "sweeps"]
