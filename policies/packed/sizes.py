"""Whose networks are computed together, by their sizes: smaller layers of a group are padded to its largest ones."""

from __future__ import annotations

from policies.hyperparams import TrainedHyperparams
from policies.portable.convolution import Filter


def size_class(num_units: int) -> int:
    """Return the most units that a hidden layer is padded to: 8, 12, 16, 24, ...; at most a third is padding."""
    size = 8
    while size < num_units:
        size = size * 3 // 2 if size & (size - 1) == 0 else size * 4 // 3
    return size


def group_key(hyperparams: TrainedHyperparams) -> tuple[str, tuple[Filter, ...], tuple[int, ...]]:
    """Return what the members of a group have in common beside what a stack's have; it is sortable.

    Convolutions are not padded: another kernel or stride sees other windows, and more filters are more inputs later.
    """
    return hyperparams.activation, hyperparams.conv_filters or (), tuple(map(size_class, hyperparams.hidden_sizes))


def is_padded_beside(ours: TrainedHyperparams, theirs: TrainedHyperparams) -> bool:
    """Return whether a member's layers are padded where it is in a group with another; both could share a stack."""
    wider = any(their > our for our, their in zip(ours.hidden_sizes, theirs.hidden_sizes, strict=False))
    return wider and group_key(ours) == group_key(theirs)
