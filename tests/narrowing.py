"""What a test knows of a value, and its type does not say."""

from typing import TypeVar

T = TypeVar("T")


def present(value: T | None) -> T:
    """A value that is there."""
    assert value is not None
    return value
