"""The env runner of this engine, under a name in tune_jobs.

An env runner in a process of its own unpickles its class there before anything else: by this name it imports
tune_jobs first, which settles what `policies` means (see `tune_jobs/process/own_packages.py`).
"""

from __future__ import annotations

from policies.rllib.env_runner import ArrayEnvRunner


class EnvRunner(ArrayEnvRunner):
    """`ArrayEnvRunner`, found by way of tune_jobs."""
