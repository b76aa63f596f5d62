"""Policies that act: loaded from files, or baselines; played, evaluated and filmed."""
