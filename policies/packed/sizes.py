"""Whose networks are computed together, by their sizes: smaller layers of a group are padded to its largest ones."""

from __future__ import annotations

from policies.hyperparams import PPOHyperparams, TrainedHyperparams
from policies.portable.convolution import Filter

LINE = 16
"""The numbers of float32 in a cache line. Where matrices do not begin at one, some CPUs multiply them by other kernels,
which round otherwise: what a network computes would depend on its place in the stack."""
NARROW = 16
"""A layer of fewer inputs or outputs is multiplied by NumPy on a CPU; from there on torch is about as fast."""


def size_class(num_units: int) -> int:
    """Return the most units that a hidden layer is padded to: 8, 12, 16, 24, ...; at most a third is padding."""
    size = 8
    while size < num_units:
        size = size * 3 // 2 if size & (size - 1) == 0 else size * 4 // 3
    return size


def group_key(hyperparams: TrainedHyperparams) -> tuple[tuple[Filter, ...], tuple[int, ...]]:
    """Return what the members of a group have in common beside what a stack's have; it is sortable.

    Convolutions are not padded: another kernel or stride sees other windows, and more filters are more inputs later.
    """
    return hyperparams.conv_filters or (), tuple(map(size_class, hyperparams.hidden_sizes))


def is_padded_beside(ours: TrainedHyperparams, theirs: TrainedHyperparams) -> bool:
    """Return whether a member's layers are padded where it is in a group with another; both could share a stack."""
    wider = any(their > our for our, their in zip(ours.hidden_sizes, theirs.hidden_sizes, strict=False))
    return wider and group_key(ours) == group_key(theirs)


def may_round_by_place(hyperparams: TrainedHyperparams, num_outputs: int | None) -> bool:
    """Return whether a member's sums may be rounded by its place among the members of its group, though none is padded.

    The weights of each network begin at a cache line, but what torch makes of a layer's inputs, and the gradients of
    that, (rows, units), begin where those of the network before it end. What a layer takes may begin anywhere, and so
    may NumPy's matrices. A layer of one unit is computed by other code where a network is alone.

    Args:
        hyperparams: The member's.
        num_outputs: The outputs of its policy; None: not known.
    """
    units = [*hyperparams.hidden_sizes, *(num_filters for num_filters, *_ in hyperparams.conv_filters or ())]
    if not isinstance(hyperparams, PPOHyperparams):
        return 1 in units or hyperparams.train_batch_size % LINE > 0
    if 1 in units or hyperparams.minibatch_size % LINE:
        return True
    # Values are computed for as many observations as there are envs, and for multiples of these.
    if num_outputs is None or num_outputs + hyperparams.vf_share_layers >= NARROW:
        units.append(1 if num_outputs is None else num_outputs + hyperparams.vf_share_layers)
    return any(hyperparams.num_envs * number % LINE for number in units)
