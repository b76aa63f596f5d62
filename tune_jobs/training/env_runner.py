"""The env runner of the rllib engine, under a name in tune_jobs.

A process of an env runner first unpickles its class. With a class in tune_jobs it imports tune_jobs first, which
decides what `policies` means (see `tune_jobs/process/own_packages.py`).
"""

from __future__ import annotations

from policies.rllib.env_runner import ArrayEnvRunner


class EnvRunner(ArrayEnvRunner):
    """`ArrayEnvRunner`, under a name that imports tune_jobs first."""
