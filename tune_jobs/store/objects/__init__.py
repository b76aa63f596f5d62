"""Sweeps in an object store, such as S3; see `tune_jobs.store.contract` for what holds, and decision 38 for how."""
