"""The name by which reports written by older versions say how a policy is loaded."""

from policies.acting.load import load_policy

__all__ = ["load_policy"]
