"""Benchmarks: `make bench`. Each number stands beside its peer's from the same run on the same machine."""
